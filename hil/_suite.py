"""The example suite: tests to copy and to change."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from ..common.files import make_folder, write_together
from ..errors import InputError

# The files are stored under names that pytest does not collect.
FILES = {"cases.py": "test_skin.py", "scene.toml": "scene.toml", "settings.ini": "pytest.ini"}


def write_suite(folder: str | Path) -> list[Path]:
    """Copy the example suite into ``folder``, which is made if it is not there.

    Returns:
        The files written.

    Raises:
        InputError: a file of the same name is there already, or the folder cannot be written.

    """
    target = make_folder(folder)
    source = importlib.resources.files(__package__) / "suite"
    contents: dict[str | Path, bytes | None] = {}
    for stored, name in FILES.items():
        if (target / name).exists():
            raise InputError(f"{target / name}: is there already; expected a folder without a suite")
        contents[target / name] = source.joinpath(stored).read_bytes()
    write_together(contents)
    return [target / name for name in FILES.values()]
