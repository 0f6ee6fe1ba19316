"""Recorder that joins a skin which is already open."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from ..common.checks import of_kind
from ._recording import Recording
from ._skin import BoardSkin


class Recorder(Recording):
    """Records an open skin, from now until :meth:`close`; readers of the skin go on undisturbed.

    ::

        with Recorder(skin, "press.mcap"):
            ...

    The recording begins with the board's description and the rest resistances in use. The replay begins with the next
    whole frame; its estimator has no memory of the frames before.
    """

    def __init__(self, skin: BoardSkin, path: str | Path, *, overwrite: bool = False) -> None:
        """Begin to record.

        Args:
            skin: an open skin.
            path: of the MCAP file.
            overwrite: replace an existing file that is not empty.

        Raises:
            InputError: the file cannot be written, or exists already.
            MissingExtra: mcap is not installed.
            LinkError: the skin has come to its end, or is closed.

        """
        of_kind("skin", skin, BoardSkin, "an open Skin")
        super().__init__(path, skin.settings_to_join().as_metadata(), overwrite=overwrite)
        try:
            skin.attach(self)
            self.keep()
        except BaseException:
            self.discard()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
