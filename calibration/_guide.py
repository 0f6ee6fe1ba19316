"""Interactive calibration of an open skin: instructions to the person who presses, and checkpoints for resumption."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..common.config import fingerprint
from ..driver import Frame, Skin
from ..errors import InputError, LinkEnded
from ..wire import Order
from ._plan import Plan
from ._progress import Progress
from ._tuning import PATIENCE_S
from ._watch import Event, HeldLongEnough, PressBegan, PressRefused, PressTaken, RestTaken, Watch

Tell = Callable[[str], None]


class Guide:
    """Guides a person, or a script, through a plan."""

    def __init__(
        self,
        skin: Skin,
        plan: Plan,
        *,
        hold_s: float,
        rest_s: float,
        tell: Tell,
        progress: Path | None = None,
        resume: bool = False,
        keep_trace: bool = False,
    ) -> None:
        """Begin a calibration, or resume one.

        Args:
            skin: an open skin, without calibration, that delivers every frame.
            plan: the presses.
            hold_s: duration of each hold.
            rest_s: duration of the rest measurement.
            tell: called with each line for the person who presses.
            progress: checkpoint file, written after each press; None: no file.
            resume: continue from the content of ``progress``.
            keep_trace: store the load over time, for a reference sensor.

        Raises:
            InputError: the skin has no data of its cells, a load is far beyond their full scale, or the checkpoint file
                belongs to another calibration.

        """
        _hear_identity(skin)
        if skin.cell is None:
            raise InputError("the board does not tell the data of its cells; give them (--cell CELL.toml)")
        plan.check_full_scale(skin.cell.full_scale_kpa)
        self._skin, self._plan, self._tell = skin, plan, tell
        self._progress, self._keep_trace = progress, keep_trace
        self._setup: dict[str, Any] = {
            "serial_number": skin.serial_number,
            "design_hash": fingerprint(skin.design),
            "cell_hash": fingerprint(skin.cell),
            "loads_kpa": list(plan.loads_kpa),
            "targets": len(plan.targets),
            "hold_s": hold_s,
        }
        before = Progress.load(progress, self._setup, plan) if resume and progress is not None else None
        self.watch = Watch(
            skin.cell,
            plan,
            hold_s=hold_s,
            rest_s=rest_s,
            rest=None if before is None else before.rest,
            presses=() if before is None else before.presses,
        )
        self._trace = [] if before is None else list(before.trace)
        self._clock = _Clock(-np.inf if before is None else before.last_s)

    @property
    def trace(self) -> list[tuple[float, float]]:
        """Times in s and largest loads in kPa, including those before a resumption."""
        return [*self._trace, *self.watch.trace]

    def run(self) -> None:
        """Read the skin until the plan is done.

        Raises:
            InputError: the skin is loaded in the rest measurement; its stream ended, or nobody pressed, before the plan
                was done.
            LinkError, ProtocolError: as for reading the skin.

        """
        watch = self.watch
        if watch.rest is None:
            self._tell("Leave the skin unloaded.")
        else:
            good = sum(not press.fault for press in watch.presses)
            self._tell(f"Going on after {good} {'press' if good == 1 else 'presses'}.")
            self._announce()
        quiet_since_s: float | None = None
        while not watch.done:
            try:
                frame = self._skin.read()
            except LinkEnded:
                raise InputError(f"the skin's frames ended {self._how_far()}") from None
            if frame.reconnected or frame.rebooted:
                watch.interrupt()
            time_s = self._clock.time_s(frame)
            events = watch.feed(time_s, np.where(frame.valid, frame.resistance, np.nan))
            for event in events:
                self._follow(event)
            if events or quiet_since_s is None:
                quiet_since_s = time_s
            if time_s - quiet_since_s > PATIENCE_S:
                raise InputError(f"nobody pressed for {PATIENCE_S:g} s {self._how_far()}")

    def _follow(self, event: Event) -> None:
        plan = self._plan
        match event:
            case RestTaken(rest):
                typical = float(np.median(rest.resistance_ohm[rest.measured]))
                read = int(rest.measured.sum())
                self._tell(f"At rest: {read} of {rest.measured.size} cells are read, typically {typical:.4g} ohm.")
                self._save()
                self._announce()
            case PressBegan(target):
                self._tell(f"  {plan.name(target)}: hold ...")
            case HeldLongEnough(target):
                self._tell(f"  {plan.name(target)}: take it off")
            case PressTaken(target, press):
                self._save()
                left = len(self.watch.missing(press.step))
                self._tell(f"  {plan.name(target)}: done, {left} to go")
                if not left:
                    self._announce()
            case PressRefused(target, press):
                self._save()
                self._tell(f"  {plan.name(target)}: not used, {press.fault}. Press again")

    def _announce(self) -> None:
        step = self.watch.step
        if step is None:
            return
        plan, missing = self._plan, self.watch.missing(step)
        where = plan.name(missing[0])
        if len(plan.targets) > 1:
            where = f"each of {len(missing)} places, such as {where}"
        self._tell(
            f"Step {step + 1} of {len(plan.loads_kpa)}: press {where}, with {plan.loads_kpa[step]:.4g} kPa on each "
            f"cell; hold for {self.watch.hold_s:g} s, then take it off."
        )

    def _save(self) -> None:
        if self._progress is None or self.watch.rest is None:
            return
        trace = tuple(self.trace) if self._keep_trace else ()
        Progress(self._setup, self.watch.rest, tuple(self.watch.presses), trace).save(self._progress)

    def _how_far(self) -> str:
        watch = self.watch
        step = watch.step
        if watch.rest is None or step is None:
            return "before the skin at rest was measured"
        missing = watch.missing(step)
        names = ", ".join(map(self._plan.name, missing[:4])) + (", ..." if len(missing) > 4 else "")
        kept = "" if self._progress is None else f"; what was measured is kept, go on with --resume ({self._progress})"
        return f"before {names} had borne {self._plan.loads_kpa[step]:.4g} kPa{kept}"


def _hear_identity(skin: Skin) -> None:
    """Wait for the serial number of the board, if its family has one; the driver may start without it."""
    if skin.family.has_description and skin.identity is None:
        skin.request(Order.IDENTIFY)


class _Clock:
    """Clock that increases over reboots and resumptions: the board's time, from the host's time at the first frame."""

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._offset_s: float | None = None

    def time_s(self, frame: Frame) -> float:
        """Time of a frame in seconds, approximately since the epoch."""
        board_s = frame.monotonic_time if frame.device_time is None else frame.device_time
        if self._offset_s is None or frame.rebooted or frame.reconnected:
            begins_s = max(frame.host_time, self._after_s + 1.0)
            self._offset_s = begins_s - board_s
        self._after_s = max(self._after_s, board_s + self._offset_s)
        return board_s + self._offset_s
