"""Recorder that joins a skin which is already open."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from ..common.checks import of_kind
from ..errors import InputError
from ._recording import Recording
from ._skin import Skin


class Recorder:
    """Records an open skin, from now until :meth:`close`; readers of the skin go on undisturbed.

    ::

        with Recorder(skin, "press.mcap"):
            ...

    The recording begins with a checkpoint of the skin (:class:`._past.Past`): the board's description, the rest
    resistances in use, the state of clock and estimator. The replay therefore gives the frames that the skin gives from
    here on, bit for bit if every frame is taken. Ids of contacts count from the join.
    """

    def __init__(self, skin: Skin, path: str | Path, *, overwrite: bool = False) -> None:
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
        self._skin = of_kind("skin", skin, Skin, "an open Skin")
        self._recording = Recording(path, skin.settings.as_metadata(), overwrite=overwrite)
        try:
            skin.attach(self._recording)
            self._recording.keep()
        except BaseException:
            skin.detach(self._recording)
            self._recording.discard()
            raise

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._recording.path

    @property
    def frames(self) -> int:
        """Decoded frames written so far."""
        return self._recording.frames

    @property
    def error(self) -> InputError | None:
        """Why the recording ended before it was closed, such as a full disk."""
        return self._recording.error

    def close(self) -> None:
        """End the recording; the skin stays open. A second call does nothing.

        Raises:
            InputError: the file could not be written to the end. The part written before can be read.

        """
        self._skin.detach(self._recording)
        self._recording.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
