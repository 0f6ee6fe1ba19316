"""Recordings as commands read them: played through the driver, with a progress bar."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..driver import Frame, Skin
from ..errors import InputError, LinkEnded
from ._bar import progress_bar


@contextmanager
def played_frames(paths: Sequence[Path], doing: str) -> Iterator[tuple[Skin, Iterator[Frame]]]:
    """A recording as an open skin, and its frames.

    Args:
        paths: of the recording, FILE.mcap; of a skin of several boards there is one for each.
        doing: what the progress bar says.

    Raises:
        InputError: it is no recording.

    """
    for path in paths:
        if path.suffix.lower() != ".mcap":
            raise InputError(f"{path}: is no name of a recording; expected FILE.mcap")
    with progress_bar("reading") as tell:
        skin = Skin.open(str(paths[0]) if len(paths) == 1 else list(map(str, paths)), progress=tell)
    with skin, progress_bar(doing) as tell:
        whole_ms = round(1e3 * (skin.recorded_s or 0.0))

        def frames() -> Iterator[Frame]:
            first_s = None
            with suppress(LinkEnded):
                while True:
                    block = skin.read_many()
                    first_s = block[0].monotonic_time if first_s is None else first_s
                    tell(min(round(1e3 * (block[-1].monotonic_time - first_s)), whole_ms), whole_ms, "")
                    yield from block

        yield skin, frames()
