"""Files that the text of a recording names: found below its folder, and nowhere else."""

from __future__ import annotations

import os
from pathlib import Path, PureWindowsPath

from tgslam.errors import DatasetError


def named_file(folder: Path, name: str, where: str) -> Path:
    """The file that a list, or the like, in `folder` calls `name`; it need not exist. `where`: file and line.

    Backslashes separate folders too, as in lists from Windows. Of an absolute path that leads elsewhere, such as that
    of the machine that wrote the list, the longest end that exists in the folder counts. Links are followed. Raises
    DatasetError for a path that leads out of the folder.
    """
    if "\0" in name or not name.strip():
        raise DatasetError(f"{where}: {name!r} is not the name of a file")
    if "\\" in name and not (folder / name).exists():
        name = name.replace("\\", "/")
    if name.startswith("/") or PureWindowsPath(name).drive:
        return _below(folder, name, where)
    path = Path(os.path.normpath(name))
    if path.parts[:1] == (os.pardir,):
        raise DatasetError(f"{where}: {name!r} leads out of the folder; move the files into it, or link to them")
    return folder / path


def _below(folder: Path, name: str, where: str) -> Path:
    parts = [part for part in PureWindowsPath(name).parts[1:] if part not in (".", "..")]
    for start in range(len(parts)):
        candidate = folder.joinpath(*parts[start:])
        if candidate.is_file():
            return candidate
    raise DatasetError(
        f"{where}: {name!r} is an absolute path, and no file of that name is below {folder}; name files by their path "
        "within the folder"
    )
