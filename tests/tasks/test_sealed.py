"""A seal finds every damage of what it stands behind, and of itself."""

import tempfile
from pathlib import Path

import pytest

from tasks.caches import (
    Damaged,
    append_checksum,
    json_with_checksum,
    parse_json_with_checksum,
    user_cache,
    verify_checksum,
    with_checksum,
    without_checksum,
)

CONTENT = bytes(range(90))


def test_caches_lie_elsewhere_where_the_home_folder_cannot_be_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert user_cache() == tmp_path / "home" / ".cache" / "driving-data-factory"
    (tmp_path / "home").touch()  # no folder can be made in it, by root neither
    found = user_cache()
    assert found.parent == tmp_path and found.stat().st_mode & 0o777 == 0o700
    assert f"{found} stands for it: name a folder in XDG_CACHE_HOME" in caplog.text
    found.rmdir()
    found.symlink_to(tmp_path)
    with pytest.raises(PermissionError, match="another user"):
        user_cache()


def damaged(whole: bytes) -> list[bytes]:
    flips = [whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :] for at in range(len(whole)) for bit in (0, 7)]
    return [*flips, *(whole[:n] for n in range(len(whole))), whole + b"\0", whole[1:], whole + whole]


def test_what_is_whole_comes_back_and_a_file_is_sealed_as_bytes_are(tmp_path: Path) -> None:
    for content in (CONTENT, b""):
        assert without_checksum(with_checksum(content)) == content
        (tmp_path / "x").write_bytes(content)
        append_checksum(tmp_path / "x")
        assert (tmp_path / "x").read_bytes() == with_checksum(content)
        verify_checksum(tmp_path / "x")


def test_every_flip_and_every_cut_is_found(tmp_path: Path) -> None:
    for data in damaged(with_checksum(CONTENT)):
        (tmp_path / "x").write_bytes(data)
        with pytest.raises(Damaged):
            without_checksum(data)
        with pytest.raises(Damaged):
            verify_checksum(tmp_path / "x")


def test_a_file_is_whole_under_its_own_key_alone(tmp_path: Path) -> None:
    data = with_checksum(CONTENT, "a")
    (tmp_path / "x").write_bytes(data)
    assert without_checksum(data, "a") == CONTENT
    verify_checksum(tmp_path / "x", "a")
    (tmp_path / "y").write_bytes(CONTENT)
    append_checksum(tmp_path / "y", "a")
    assert (tmp_path / "y").read_bytes() == data
    for key in ("b", "", "aa"):
        with pytest.raises(Damaged):
            without_checksum(data, key)
        with pytest.raises(Damaged):
            verify_checksum(tmp_path / "x", key)
    with pytest.raises(Damaged, match="under this name"):
        without_checksum(with_checksum(CONTENT), "a")


def test_json_is_read_by_anyone_and_holds_its_own_checksum() -> None:
    members = {"cameras": [{"name": "ü", "shift_m": [0.1, float("nan")]}], "left_out": [], "ego_shift_m": 1e-9}
    text = json_with_checksum(members)
    assert str(parse_json_with_checksum(text.encode())) == str(members)
    for data in damaged(text.encode()):
        with pytest.raises(Damaged):
            parse_json_with_checksum(data)
    for other in (b"[]", b"[" * 100_000, b'{"sha256": 1}', b"1", b'{"a": 1}'):
        with pytest.raises(Damaged):
            parse_json_with_checksum(other)
