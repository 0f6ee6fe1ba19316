"""A skin as LeRobot observes: ``get_observation()``, ``observation_features``, ``connect()``, ``is_connected``.

    robot = RobotWithSkin(my_robot, SkinSensor("/dev/ttyACM0", shape=(8, 8), form="cells"))
    robot.connect()
    robot.get_observation()  # what my_robot observes, and the skin's cells

The methods and their meaning are those of ``lerobot.robots.Robot`` (LeRobot 0.4). LeRobot itself is not needed.

LeRobot's data sets hold floats, which become one state vector, and images of uint8. For recording with LeRobot take the
form ``cells`` up to some hundred cells, else ``image``. The form ``arrays`` is for your own policies.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ohmskin.driver import Frame, Skin

Form = Literal["arrays", "cells", "image"]
"""what an observation is made of

``arrays``
    ``NAME.pressure``, ``NAME.pressure_std`` (kPa, float32) and ``NAME.valid`` (bool), each (rows, columns). With
    ``history`` each is (history, rows, columns), the newest frame last, beside ``NAME.monotonic_time`` (s, float64) and
    ``NAME.is_new`` (bool: came since the last observation), each (history,).
``cells``
    one float in kPa for each cell, ``NAME_ROW_COLUMN.kpa``.
``image``
    ``NAME``, uint8 (rows, columns, 3): grey, 255 at ``full_scale_kpa``.
"""


class SkinSensor:
    """One skin. A cell without a valid reading keeps its last pressure, 0 before the first; ``arrays`` also says so."""

    def __init__(
        self,
        port: str,
        *,
        shape: tuple[int, int],
        name: str = "skin",
        form: Form = "arrays",
        max_age: float = 0.1,
        history: int = 0,
        full_scale_kpa: float = 100.0,
        **options: Any,
    ) -> None:
        """Nothing is opened before :meth:`connect`.

        Args:
            port: for ``Skin.open``.
            shape: (rows, columns), since LeRobot asks for the features before it connects.
            name: begins the keys of the observation.
            form: see :data:`Form`.
            max_age: s; no observation is older. A skin that is silent for longer raises ``TimeoutError``.
            history: number of frames in an observation of the form ``arrays``, for policies that are slower than the
                skin; 0: the newest one, without an axis for frames. A skin that has sent fewer repeats its oldest one.
            full_scale_kpa: of the image.
            options: for ``Skin.open``.

        """
        self.port, self.shape, self.name, self.form = port, shape, name, form
        self.max_age, self.full_scale_kpa = max_age, full_scale_kpa
        self._options = options
        self.history = history
        self._seen_until = 0.0
        self._skin: Skin | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        """Key -> float, or the shape of the array."""
        match self.form:
            case "arrays":
                frames = (self.history,) if self.history else ()
                cells = {
                    f"{self.name}.{field}": (*frames, *self.shape) for field in ("pressure", "pressure_std", "valid")
                }
                return cells | {f"{self.name}.{field}": frames for field in ("monotonic_time", "is_new") if frames}
            case "cells":
                return {self._cell(*place): float for place in np.ndindex(self.shape)}
            case "image":
                return {self.name: (*self.shape, 3)}

    @property
    def is_connected(self) -> bool:
        """Whether the board is there; False while the driver tries to open its port again."""
        return self._skin is not None and self._skin.away is None

    @property
    def is_calibrated(self) -> bool:
        """Whether the skin is tared."""
        return self._skin is not None and self._skin.tared is not None

    def connect(self, calibrate: bool = True) -> None:
        """Open the skin and, unless told otherwise, tare it: nothing may touch it then.

        Raises:
            ConnectionError: it is connected already, or has another shape.
            ohmskin.errors.LinkError: the port is not there.
            ohmskin.errors.InputError: the skin seems to be loaded.

        """
        if self._skin is not None:
            raise ConnectionError(f"{self.port}: is connected already")
        skin = Skin.open(self.port, **self._options)
        try:
            if skin.shape != self.shape:
                raise ConnectionError(f"{self.port}: a skin of {skin.shape} cells; expected {self.shape}")
            if calibrate:
                skin.tare()
        except BaseException:
            skin.close()
            raise
        self._skin = skin

    @property
    def places_mm(self) -> Any:
        """(rows, columns, 2 or 3) x, y and maybe z of the cells, NaN where there is none.

        Raises:
            ConnectionError: not connected.

        """
        return self._opened().geometry.places_mm

    def calibrate(self) -> None:
        """Take the skin for unloaded now."""
        self._opened().tare()

    def configure(self) -> None:
        """Nothing to do: the board describes itself."""

    def get_observation(self) -> dict[str, Any]:
        """The newest frame, never older than ``max_age``, waiting as long for one if need be.

        Raises:
            ConnectionError: not connected, or the board has gone away for good.
            TimeoutError: no frame is young enough.

        """
        skin = self._opened()
        newest = skin.latest(self.max_age, timeout=self.max_age)
        if not self.history or self.form != "arrays":
            return self._observation(newest)
        frames = [one for one in skin.frames_since(0.0) if one.monotonic_time <= newest.monotonic_time][-self.history :]
        frames = (self.history - len(frames)) * frames[:1] + frames
        each = [self._observation(one) for one in frames]
        times = np.array([one.monotonic_time for one in frames])
        is_new, self._seen_until = times > self._seen_until, newest.monotonic_time
        stacked = {key: np.stack([one[key] for one in each]) for key in each[0]}
        return stacked | {f"{self.name}.monotonic_time": times, f"{self.name}.is_new": is_new}

    def disconnect(self) -> None:
        """Close the skin."""
        skin = self._opened()
        self._skin = None
        skin.close()

    def _observation(self, frame: Frame) -> dict[str, Any]:
        pressure = np.nan_to_num(frame.pressure, nan=0.0)
        match self.form:
            case "arrays":
                values = {"pressure": pressure, "pressure_std": frame.pressure_std, "valid": frame.valid}
                types = {"pressure": np.float32, "pressure_std": np.float32, "valid": np.bool_}
                return {f"{self.name}.{field}": value.astype(types[field]) for field, value in values.items()}
            case "cells":
                return {self._cell(*place): float(pressure[place]) for place in np.ndindex(self.shape)}
            case "image":
                grey = np.clip(np.round(255 * pressure / self.full_scale_kpa), 0, 255).astype(np.uint8)
                return {self.name: np.repeat(grey[:, :, None], 3, axis=2)}

    def _cell(self, row: int, column: int) -> str:
        return f"{self.name}_{row}_{column}.kpa"

    def _opened(self) -> Skin:
        if self._skin is None:
            raise ConnectionError(f"{self.port}: is not connected; call connect() first")
        return self._skin


class RobotWithSkin:
    """A LeRobot robot whose observations include a skin's. All that is not here is the robot's."""

    def __init__(self, robot: Any, sensor: SkinSensor) -> None:
        self.robot, self.sensor = robot, sensor

    def __getattr__(self, name: str) -> Any:
        return getattr(self.robot, name)

    @property
    def observation_features(self) -> dict[str, Any]:
        """Those of both."""
        return {**self.robot.observation_features, **self.sensor.observation_features}

    @property
    def is_connected(self) -> bool:
        """Whether both are."""
        return bool(self.robot.is_connected) and self.sensor.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether both are."""
        return bool(self.robot.is_calibrated) and self.sensor.is_calibrated

    def connect(self, calibrate: bool = True) -> None:
        """Connect both, the skin first: it is tared before the robot moves."""
        self.sensor.connect(calibrate)
        try:
            self.robot.connect(calibrate)
        except BaseException:
            self.sensor.disconnect()
            raise

    def calibrate(self) -> None:
        """Calibrate both, the skin first."""
        self.sensor.calibrate()
        self.robot.calibrate()

    def configure(self) -> None:
        """Configure both."""
        self.robot.configure()
        self.sensor.configure()

    def get_observation(self) -> dict[str, Any]:
        """What both observe."""
        return {**self.robot.get_observation(), **self.sensor.get_observation()}

    def disconnect(self) -> None:
        """Disconnect both, whatever one of them says."""
        try:
            self.robot.disconnect()
        finally:
            self.sensor.disconnect()
