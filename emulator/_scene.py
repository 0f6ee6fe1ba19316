"""SCENE.toml: which skin and board to emulate, and what presses on it when. ``docs/scene.md`` is the format."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from ..cell import Cell, drifted_rest_resistance
from ..circuits import Design
from ..common.arrays import FloatArray, IntArray
from ..common.config import Finite, LocalFile, NotNegative, Positive, Section, parse, read_toml
from ..common.geometry import Geometry
from ..errors import InputError
from ._contacts import Contact
from ._events import Event, check_events
from ._line_settings import ClockSettings, LineSettings, LinkFault
from ._loads import check_order
from ._movie import Movie

DEMO = Path(__file__).parent / "demo.toml"
"""the shipped scene: ``ohmskin demo``, ``Skin.open("ohmskin://demo")``"""
Percent = Annotated[float, Field(ge=0, le=1000)]
DriftPoint = Annotated[tuple[Finite, Annotated[float, Field(ge=-300, le=1000)]], Field(strict=False)]


class CellSpread(Section):
    """How much the cells of one skin differ from each other. The board and its host do not know of it."""

    rest_percent: Percent = 0.0
    """standard deviation of ln R0, times 100"""
    sensitivity_percent: Percent = 0.0
    """standard deviation of the logarithm of the pressure that a cell feels under the same load, times 100"""
    seed: Annotated[int, Field(ge=0)] = 0

    def draw(self, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """(rows, columns) factors of R0, and of the pressure that the cells feel."""
        random = np.random.default_rng(self.seed)
        rest, sensitivity = random.standard_normal((2, *shape))
        return np.exp(self.rest_percent / 100.0 * rest), np.exp(self.sensitivity_percent / 100.0 * sensitivity)


class Drift(Section):
    """What temperature and age do to the resistance of all cells (:func:`ohmskin.cell.drifted_rest_resistance`)."""

    temperature_change_c: Annotated[list[DriftPoint], Field(min_length=1)] | Finite = 0.0
    """degC since the cell was identified: one number, or [time in s, degC] with straight lines between"""
    percent_per_degree: Annotated[float, Field(gt=-100, le=1000)] = 7.0
    """of R0"""
    age_hours: NotNegative = 0.0
    """since the cell was identified"""
    percent_per_decade: Finite = 0.0
    """of R0, per tenfold age"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        points = self.temperature_change_c
        check_order("temperature_change_c", points if isinstance(points, list) else ())
        return self

    def check(self) -> None:
        """Raises InputError for a drift that no material has."""
        points = self.temperature_change_c
        self.factor(np.array([time for time, _ in points]) if isinstance(points, list) else np.zeros(1))

    def factor(self, time_s: FloatArray) -> FloatArray:
        """(frames,) factor of all resistances at each of ``time_s``."""
        points = self.temperature_change_c
        times, changes = np.transpose(points if isinstance(points, list) else [(0.0, points)])
        change = np.interp(time_s, times, changes)
        age = drifted_rest_resistance(1.0, age_s=3600.0 * self.age_hours, per_decade=self.percent_per_decade / 100.0)
        warm = np.exp(np.log1p(self.percent_per_degree / 100.0) * change)
        factor: FloatArray = age * warm
        if not ((factor > 1e-6) & (factor < 1e6)).all():
            raise InputError("skin.drift changes the resistance more than a million times")
        return factor


class SkinSettings(Section):
    """The ``[skin]`` table: how the skin is read, and what it is made of.

    :class:`._skin.EmulatedSkin` is the skin itself, alive; :class:`ohmskin.driver.Skin` is what a host sees of one.
    """

    design: Design
    cell: Cell = Field(default_factory=Cell.example)
    pitch_mm: Annotated[float | None, Field(ge=1e-3, le=1e6)] = None
    """from cell to cell along rows and columns; None: design.sheet.pitch"""
    cover_thickness: NotNegative = 0.0
    """m of silicone above the cells, which shares the pressure among them; a continuous sheet does so itself"""
    spread: CellSpread = CellSpread()
    drift: Drift = Drift()

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if self.design.shape is not None and (self.pitch_mm is not None or self.cover_thickness):
            key = "cover_thickness" if self.cover_thickness else "pitch_mm"
            raise ValueError(f"{key} has no effect on a skin with a [shape], whose cells lie anywhere; leave it out")
        return self

    @property
    def described_design(self) -> Design:
        """The design as the board describes it to a host: with the pitch that the scene gives the cells.

        The geometry of a continuous sheet also sets how its cells couple, so that it stays as the design has it.
        """
        if self.pitch_mm is None or self.design.array.sheet == "continuous":
            return self.design
        pitch = self.pitch_mm / 1000.0
        return self.design.replace(
            sheet={"pitch": pitch, "electrode_width": min(self.design.sheet.electrode_width, pitch)}
        )

    @cached_property
    def geometry(self) -> Geometry:
        """Where the cells are."""
        if self.design.shape is not None:
            return self.design.geometry
        return Geometry.rectangle(self.design.array.shape, self.cell_pitch_mm / 1000.0)

    @property
    def cell_pitch_mm(self) -> float:
        """From cell to cell, along rows and columns."""
        return self.design.sheet.pitch * 1000.0 if self.pitch_mm is None else self.pitch_mm

    @property
    def spreading_pitches(self) -> float:
        """Depth, over the pitch, at which the cells feel the pressure: below the cover, mid-way in an uncut sheet."""
        sheet = self.design.sheet
        uncut = sheet.thickness / 2 if self.design.array.sheet == "continuous" else 0.0
        return (self.cover_thickness + uncut) / (self.cell_pitch_mm / 1000.0)


class BoardSettings(Section):
    """The board behind the skin."""

    frame_rate: Annotated[float, Field(ge=1e-3, le=100_000)] = 50.0
    """Hz"""
    serial_number: Annotated[str, Field(max_length=64, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")] = "EMULATED"
    """without control characters, which would reach the terminals that show it"""
    noise: NotNegative = 0.0
    """V rms, white, at the input of the ADC"""
    reference_resistances: Annotated[tuple[Positive, ...], Field(strict=False, max_length=64)] = ()
    """ohm of resistors that the board's self-test can read in place of a cell"""


class Scene(Section):
    """A skin, its board, the line, and what happens to them. ``Scene.load("scene.toml")``."""

    skin: SkinSettings
    board: BoardSettings = BoardSettings()
    line: LineSettings = LineSettings()
    clock: ClockSettings = ClockSettings()
    link_fault: list[LinkFault] = Field(default_factory=list)
    contact: list[Contact] = Field(default_factory=list)
    event: list[Event] = Field(default_factory=list)
    movie: Movie | None = None

    @model_validator(mode="after")
    def _converts(self) -> Self:
        adc = self.skin.design.adc
        if adc is None or adc.bits > 16:
            raise ValueError("skin.design needs an [adc] of at most 16 bits: a board sends counts")
        return self

    @model_validator(mode="after")
    def _on_the_skin(self) -> Self:
        for k, contact in enumerate(self.contact):
            try:
                contact.check(self.skin.geometry)
            except InputError as error:
                raise ValueError(f"contact[{k}]{'.' if contact.cells else ': '}{error}") from error
        check_events(self.event, self.skin.design)
        if self.contact and self.movie is not None and self.movie.quantity == "resistance":
            raise ValueError("a movie of resistance leaves nothing to the contacts; expected one or the other")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read SCENE.toml and the files it names; InputError with one located message if one is at fault."""
        return cls.from_tables(read_toml(path), source=str(path), directory=Path(path).parent)

    @classmethod
    def from_tables(cls, tables: Mapping[str, Any], *, source: str, directory: Path) -> Scene:
        """A scene from TOML tables; ``directory`` is where the paths in it start."""
        try:
            whole = _with_parts(tables, source, directory)
        except RecursionError as error:
            raise InputError(f"{source}: tables are nested too deeply") from error
        scene = parse(whole, cls, source=source, folder=directory)
        try:
            scene.read_files()
        except InputError as error:
            raise InputError(f"{source}: {error}") from error
        return scene

    def read_files(self) -> None:
        """Read recordings, pictures and movies, so that an error comes before the first frame. Raises InputError."""
        for contact in self.contact:
            contact.read_files()
        if self.movie is not None:
            self.movie.frames(self.skin.design.array.shape)
        self.skin.drift.check()

    def pressure_kpa(self, time_s: float) -> FloatArray:
        """(rows, columns) kPa on the surface at ``time_s``: contacts add up."""
        total = np.zeros(self.skin.design.array.shape)
        cells, pressure = self.pressure_on(np.array([time_s]))
        total.flat[cells] = pressure[0]
        return total

    def pressure_on(self, time_s: FloatArray) -> tuple[IntArray, FloatArray]:
        """The cells that are pressed at any of ``time_s`` (frames,), and how hard: contacts and a movie add up.

        Returns:
            (k,) indices into the flattened array in rising order, and (frames, k) kPa.

        """
        shape = self.skin.design.array.shape
        parts = [contact.pressure_on(time_s, self.skin.geometry) for contact in self.contact]
        if self.movie is not None and self.movie.quantity == "pressure":
            shown = self.movie.at(time_s, shape).reshape(len(time_s), -1)
            cells = np.flatnonzero(shown.any(axis=0))
            parts.append((cells, shown[:, cells]))
        if not parts:
            return np.empty(0, dtype=np.intp), np.empty((len(time_s), 0))
        touched = np.unique(np.concatenate([cells for cells, _ in parts]))
        pressure = np.zeros((len(time_s), len(touched)))
        for cells, part in parts:
            pressure[:, np.searchsorted(touched, cells)] += part
        return touched, pressure


class SharedScene(Section):
    """Boards of one skin, each with a scene of its own, and what presses on all of them."""

    boards: Annotated[list[LocalFile], Field(min_length=1, max_length=64)]
    """scenes, relative to the file; the cells of each board are placed by the ``[shape]`` of its design"""
    contact: list[Contact] = Field(default_factory=list)
    """in mm; on each board that they reach"""


def load_scenes(path: str | Path) -> tuple[Scene, ...]:
    """The scene of each board that a file describes: one SCENE.toml, or ``boards`` with contacts that they share.

    Raises:
        InputError: a file is at fault, or a shared contact reaches no board.

    """
    tables = read_toml(path)
    if "boards" not in tables:
        return (Scene.from_tables(tables, source=str(path), directory=Path(path).parent),)
    shared = parse(tables, SharedScene, source=str(path), folder=Path(path).parent)
    scenes = [Scene.load(file) for file in shared.boards]
    on_each: list[list[Contact]] = [list(scene.contact) for scene in scenes]
    for k, contact in enumerate(shared.contact):
        reached, why = False, ""
        for scene, contacts in zip(scenes, on_each, strict=True):
            try:
                contact.check(scene.skin.geometry)
            except InputError as error:
                why = str(error)
            else:
                contacts.append(contact)
                reached = True
        if not reached:
            raise InputError(f"{path}: contact[{k}]: on no board: {why}")
    found = tuple(scene.replace(contact=contacts) for scene, contacts in zip(scenes, on_each, strict=True))
    for scene in found:
        scene.read_files()
    return found


def _with_parts(tables: Mapping[str, Any], source: str, directory: Path) -> Mapping[str, Any]:
    """The tables with the files of design and cell in place of their names."""
    skin = tables.get("skin")
    if not isinstance(skin, Mapping):
        return tables
    parts: dict[str, Any] = {}
    for key, kind in (("design", Design), ("cell", Cell)):
        if isinstance(skin.get(key), str):
            try:
                parts[key] = kind.load(directory / skin[key])
            except InputError as error:
                raise InputError(f"{source}: skin.{key}: {error}") from error
    return {**tables, "skin": {**skin, **parts}}
