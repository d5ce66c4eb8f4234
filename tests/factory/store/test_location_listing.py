"""Listing a folder in which other processes make and remove folders."""

import shutil
from pathlib import Path

import pytest
from pyarrow import fs

from factory.store.location import LISTED_AGAIN, Location


class Restless:
    """Local files, where a folder goes away after its name was read and before it is opened, so many times."""

    def __init__(self, going: Path, times: int) -> None:
        self.going, self.left = going, times

    def get_file_info(self, selector: fs.FileSelector) -> list[fs.FileInfo]:
        if self.left:
            self.left -= 1
            shutil.rmtree(self.going)
            try:
                return list(fs.LocalFileSystem().get_file_info(fs.FileSelector(str(self.going))))
            finally:
                self.going.mkdir()
        return list(fs.LocalFileSystem().get_file_info(selector))


@pytest.fixture
def out(tmp_path: Path) -> Location:
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "file").write_text("here")
    (tmp_path / "going").mkdir()
    return Location.parse(tmp_path)


def restless(out: Location, times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Restless(Path(out.uri, "going"), times)
    monkeypatch.setattr(Location, "filesystem", lambda self: (folder, self.uri))


@pytest.mark.parametrize("times", [1, LISTED_AGAIN])
def test_a_folder_that_vanishes_while_it_is_listed_costs_one_more_listing(
    out: Location, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    restless(out, times, monkeypatch)
    assert out.names() == ["kept/file"]
    restless(out, times, monkeypatch)
    assert list(out.ages_s(0.0)) == ["kept/file"]


def test_a_place_that_cannot_be_listed_is_not_asked_for_ever(out: Location, monkeypatch: pytest.MonkeyPatch) -> None:
    restless(out, LISTED_AGAIN + 1, monkeypatch)
    with pytest.raises(FileNotFoundError, match="going"):
        out.names()


def test_a_folder_that_is_not_there_has_no_files(tmp_path: Path) -> None:
    assert Location.parse(tmp_path / "nowhere").names() == []
