"""Files are replaced whole, or made only where there is none."""

import os
import threading
from pathlib import Path

import pytest

from restock.files import write_bytes, write_text


def test_write_replaces_file_and_makes_folder(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "file.txt"
    write_text(path, "première")
    write_text(path, "second")
    assert path.read_text(encoding="utf-8") == "second"
    assert [item.name for item in path.parent.iterdir()] == ["file.txt"]


def test_exclusive_write_never_replaces(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_bytes(path, b"first", exclusive=True)
    with pytest.raises(FileExistsError):
        write_bytes(path, b"second", exclusive=True)
    assert path.read_bytes() == b"first"
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_pipe_is_written_not_replaced(tmp_path: Path) -> None:
    """Nor /dev/null, by whoever may replace it."""
    pipe, heard = tmp_path / "pipe", list[str]()
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()), daemon=True)
    reader.start()
    write_text(pipe, "told")
    reader.join(10)
    assert heard == ["told"]
    assert pipe.is_fifo()
