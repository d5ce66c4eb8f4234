"""Listing a folder in which other processes make and remove folders."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from factory.store.location import Location


def test_a_folder_that_vanishes_while_it_is_listed_has_no_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("kept", "going"):
        (tmp_path / name).mkdir()
    (tmp_path / "kept" / "file").write_text("here")
    out, scandir = Location.parse(tmp_path), os.scandir

    def gone_once_named(folder: Path) -> Iterator[os.DirEntry[str]]:
        entries = list(scandir(folder))
        if folder == tmp_path:
            (tmp_path / "going").rmdir()
        return iter(entries)

    monkeypatch.setattr(os, "scandir", gone_once_named)
    assert out.names() == ["kept/file"]
    (tmp_path / "going").mkdir()
    assert list(out.ages_s(0.0)) == ["kept/file"]


def test_a_folder_that_is_not_there_has_no_files(tmp_path: Path) -> None:
    assert Location.parse(tmp_path / "nowhere").names() == []
