"""What is written appears at once and complete, or not at all."""

from pathlib import Path

import pytest

from delayrl.errors import DelayRLError
from delayrl.run.disk import disk_errors, draft, write_file


class FullDiskError(OSError):
    pass


@pytest.mark.parametrize("shared", [False, True])
def test_a_failed_write_leaves_what_was_there(shared: bool, tmp_path: Path) -> None:
    file = tmp_path / "rows.jsonl"
    write_file(file, b"old", shared=shared)

    def fail() -> None:
        with draft(file, shared=shared) as name:
            name.write_bytes(b"half")
            raise FullDiskError

    with pytest.raises(FullDiskError):
        fail()
    assert file.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["rows.jsonl"]


def test_a_folder_appears_with_all_of_its_files(tmp_path: Path) -> None:
    with draft(tmp_path / "step") as name:
        name.mkdir()
        (name / "agent").write_bytes(b"1")
        assert not (tmp_path / "step").exists()
    assert (tmp_path / "step" / "agent").read_bytes() == b"1"


def test_what_a_killed_process_left_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / ".step.draft").mkdir()
    (tmp_path / ".step.draft" / "half").write_bytes(b"0")
    with draft(tmp_path / "step") as name:
        name.mkdir()
    assert list((tmp_path / "step").iterdir()) == []


def test_what_the_disk_refuses_is_one_line(tmp_path: Path) -> None:
    words = "No such file or directory; what was stored before is kept"
    with pytest.raises(DelayRLError, match=words), disk_errors(tmp_path):
        write_file(tmp_path / "missing" / "file", b"")
