"""Configuration files: TOML to checked, frozen models (pydantic) and back.

The types and limits are declared on the models. This module reads and writes the files, and turns pydantic's
structured errors into one line that names the file, the key and what was expected.

Tables come from a file of the user's own (:func:`load`) or from an untrusted source: a board, a recording, the network
(:func:`parse` without a folder). Untrusted tables are values only. A key that names a file, or that leads to code or
to a verdict, is marked on its model (:data:`LocalFile`, :data:`OWN_TABLES`) and refused there. Models that a program
makes in Python are its own: a :class:`~pathlib.Path` and a checked model are no text, and are taken.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar, get_args, get_origin

import tomli_w
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, ValidationInfo
from pydantic_core import ErrorDetails

from ..errors import InputError
from .files import read_text
from .json_text import finite_or_text, replaced
from .tables import write_text
from .text import printable, shortened, shown

MOST_SI, LEAST_SI = 1e30, 1e-30
"""Quantities in SI units lie far within these limits, and products of a few of them neither overflow nor vanish."""

MOST_CELLS = 256 * 256
"""of a skin"""
MOST_LEVELS = 64
"""of tables and lists in each other"""
LONGEST_KEY = 200
"""characters of a dotted key that a message repeats"""
MOST_HOMES = 3
"""tables with the same key that a message names"""
LIKELY_SLIP = 0.8
"""similarity (difflib) from which an unknown key may be a misspelt one"""

Finite = Annotated[float, Field(ge=-MOST_SI, le=MOST_SI, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=LEAST_SI, le=MOST_SI, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=MOST_SI, allow_inf_nan=False)]


def _located(value: Any, info: ValidationInfo) -> Any:
    """The path of a file that is named relative to the file which names it."""
    if not isinstance(value, str):
        return value
    if not value or "\0" in value:
        raise ValueError("expected the name of a file")
    if info.context is None:
        raise ValueError(
            "names a file; only a file of your own may do so (in Python: a Path), no board and no recording"
        )
    return Path(info.context) / value


def _of_the_user(value: Any, info: ValidationInfo) -> Any:
    items = value if isinstance(value, list | tuple) else [value]
    made = all(isinstance(item, BaseModel) for item in items)
    if info.context is None and not made:
        raise ValueError("only a file of your own may hold such tables, no board and no recording")
    return value


LocalFile = Annotated[Path, BeforeValidator(_located)]
"""a key that names a file; it holds the path, which starts at the folder of the file that has the key"""
OWN_TABLES = BeforeValidator(_of_the_user)
"""marks a list of tables that an untrusted source may not send"""


class Section(BaseModel):
    """One table of a configuration file: immutable, no unknown keys, no conversion of text to numbers."""

    model_config = ConfigDict(defer_build=True, frozen=True, extra="forbid", strict=True)

    def replace(self, **changes: Any) -> Self:
        """A copy with some keys changed, validated as a whole like a file.

        Args:
            changes: new values by key. A mapping given for a key that holds a table changes the keys that it names and
                keeps the others: ``design.replace(array={"row_lead": 5.0}, drive={"voltage": -0.5})``.

        Raises:
            InputError: an unknown key, or a value that does not fit.

        """
        tables = self._tables()
        for key, value in changes.items():
            table = tables.get(key)
            tables[key] = (
                table._tables() | dict(value) if isinstance(table, Section) and isinstance(value, Mapping) else value
            )
        return parse(tables, type(self), source=type(self).__name__)

    def _tables(self) -> dict[str, Any]:
        """Values of the keys that were given, so that a copy knows which were, too."""
        return {key: getattr(self, key) for key in type(self).model_fields if key in self.model_fields_set}

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """As pydantic's, but an update goes through :meth:`replace`: pydantic would not check it."""
        return self.replace(**update) if update else super().model_copy(deep=deep)


S = TypeVar("S", bound=BaseModel)


def load(path: str | Path, model: type[S]) -> S:
    """Read a TOML file into ``model``.

    Raises:
        InputError: the file is missing, is not TOML, or does not fit the model. The message is one line.

    """
    return parse(read_toml(path), model, source=str(path), folder=Path(path).parent)


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file; InputError when there is no such file, it is too large, or it is not TOML."""
    return parse_toml(read_text(path), path)


def parse_toml(text: str, path: str | Path) -> dict[str, Any]:
    """The tables of a TOML text, which ``path`` names in messages; InputError when it is not TOML."""
    if not text.strip():
        raise InputError(f"{path}: the file is empty; expected TOML tables")
    try:
        tables = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{path}: not valid TOML: arrays or tables are nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and integers of more digits than Python converts
        raise InputError(f"{path}: not valid TOML: {shortened(str(error), 200)}") from error
    if _depth_exceeds(tables, MOST_LEVELS):
        raise InputError(f"{path}: tables are nested too deeply; expected at most {MOST_LEVELS} levels")
    return tables


def _depth_exceeds(value: Any, most: int) -> bool:
    """Whether tables and lists are nested in more than ``most`` levels. Dotted keys nest without recursion in TOML."""
    level = [value]
    for _ in range(most + 1):
        level = [
            item
            for outer in level
            if isinstance(outer, dict | list)
            for item in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return False
    return True


def write_toml(path: str | Path, tables: Mapping[str, Any], *, comment: str = "") -> None:
    """Write nested tables of numbers, strings and lists as TOML, whole or not at all.

    Args:
        path: where to.
        tables: values by key, for example from ``section.model_dump(exclude_none=True)``; TOML has no null.
        comment: goes to the head of the file, each line behind a ``#``.

    Raises:
        InputError: the file cannot be written.

    """
    head = "".join(f"# {printable(line)}\n" for line in comment.splitlines())
    write_text(path, head + tomli_w.dumps(tables))


def parse(tables: Mapping[str, Any], model: type[S], *, source: str, folder: Path | None = None) -> S:
    """Check ``tables`` against ``model``.

    Args:
        tables: values by key.
        model: what they must fit.
        source: names the tables in messages.
        folder: of the user's own file that holds the tables; None: they are untrusted, and may name no file.

    Raises:
        InputError: they do not fit. The message is one line.

    """
    try:
        _check_integers(tables, source)
        return model.model_validate(tables, context=folder)
    except RecursionError as error:
        raise InputError(f"{source}: tables are nested too deeply") from error
    except ValidationError as error:
        raise InputError(f"{source}: {describe(error, model, tables)}") from None  # which repeats keys raw


def fingerprint(values: BaseModel | Mapping[str, Any]) -> str:
    """SHA-256 of the values, in hexadecimal: the same for files that say the same in other words.

    Of a model, what differs from its defaults: a key that a later version adds changes no hash.
    """
    tables = values.model_dump(exclude_defaults=True) if isinstance(values, BaseModel) else values
    return hashlib.sha256(
        json.dumps(replaced(tables, finite_or_text), sort_keys=True, default=str).encode()
    ).hexdigest()


def toml_value(value: Any) -> str:
    """A value as TOML, on one line."""
    match value:
        case bool() | str():
            return json.dumps(value, ensure_ascii=False)  # a TOML basic string has the escapes of JSON
        case int():
            return str(value)
        case float():
            return (
                repr(value) if math.isfinite(value) else "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
            )
        case Mapping():
            return "{ " + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + " }"
        case Sequence():
            return "[" + ", ".join(map(toml_value, value)) + "]"
    raise InputError(f"{value!r} is no value of TOML")


def describe(error: ValidationError, model: type[BaseModel], tables: Mapping[str, Any]) -> str:
    """The first fault of a failed validation of ``tables``, in one line: key, what is wrong, what was expected."""
    # An unknown key explains a missing one (a slip of the pen), so it goes first.
    first = min(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
    where = shortened(_dotted(first["loc"]), LONGEST_KEY)
    match first["type"]:
        case "extra_forbidden":
            *table, key = first["loc"]
            return f"unknown key '{where}'{_hint(model, tuple(table), str(key), tables)}"
        case "missing":
            return f"missing key '{where}'"
        case "union_tag_not_found":
            return f"missing key '{where}.{_kind_key(first)}'"
        case "value_error":
            message = str(first["ctx"]["error"])
        case "tuple_type" | "list_type":
            message = "expected a list [...]" if not isinstance(first["input"], dict) else "expected [[...]], not [...]"
        case "dict_type" | "model_type" | "model_attributes_type":
            message = "expected a table"
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal" as kind:
            ((_, limit),) = first["ctx"].items()
            message = f"input should be {kind.replace('_', ' ').replace('than equal', 'than or equal to')} {limit:g}"
        case _:
            message = first["msg"][0].lower() + first["msg"][1:]
    given = first["input"]
    if first["type"] == "union_tag_invalid":  # the kind of a table, of which there are several
        where, given = f"{where}.{_kind_key(first)}", first["ctx"]["tag"]
        *others, last = first["ctx"]["expected_tags"].split(", ")
        message = f"input should be {', '.join(others)} or {last}"
    got = "" if isinstance(given, (dict, BaseModel)) else f" (got {shown(given)})"
    return f"{where}: {message}{got}" if where else f"{message}{got}"


def _kind_key(fault: ErrorDetails) -> str:
    """The key that tells tables of several kinds apart, of a fault that is about it."""
    return str(fault["ctx"]["discriminator"]).strip("'")


def _check_integers(value: Any, source: str, where: str = "") -> None:
    """InputError for an integer beyond TOML's 64 bits, which no validator could turn into a float."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            _check_integers(item, source, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _check_integers(item, source, f"{where}[{index}]")
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        where = shortened(where, LONGEST_KEY)
        raise InputError(f"{source}: {where}: an integer has at most 64 bits (got {shown(value)})")


def _dotted(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        path += f"[{part}]" if isinstance(part, int) else f".{part}" if path else str(part)
    return path


def _hint(model: type[BaseModel], location: tuple[int | str, ...], key: str, tables: Mapping[str, Any]) -> str:
    """What may be meant by an unknown ``key`` of the table at ``location``: a key of another table, or a slip."""
    homes = _places_of(key, model)
    here = _keys(_model_at(model, location))
    if not homes:
        with_unit = [known for known in here if known.startswith(f"{key}_")]
        near = difflib.get_close_matches(key, here, n=1, cutoff=LIKELY_SLIP)
        near = near or difflib.get_close_matches(key, with_unit or here, n=1, cutoff=0.0)
        if near and near[0] in _table_at(tables, location):
            return f"; the nearest known key, '{near[0]}', is there already"
        return f"; the nearest known key is '{near[0]}'" if near else ""
    slip = difflib.get_close_matches(key, here, n=1, cutoff=LIKELY_SLIP)
    nearest = f"; the nearest known key is '{slip[0]}'" if slip else ""
    more = f" and {len(homes) - MOST_HOMES} other tables" if len(homes) > MOST_HOMES else ""
    return f"{nearest}; the key belongs {', '.join(homes[:MOST_HOMES])}{more}"


def _places_of(key: str, model: type[BaseModel]) -> list[str]:
    """Where in a file of this model ``key`` may stand, outermost tables first."""
    places: list[str] = []
    queue: list[tuple[str, str, tuple[type[BaseModel], ...]]] = [("", "before the first table", (model,))]
    while queue:
        path, place, within = queue.pop(0)
        for attribute, field in within[-1].model_fields.items():
            name = field.alias or attribute
            inner_path = f"{path}.{name}" if path else name
            tables = _models_in(field.annotation)
            head = f"[[{inner_path}]]" if any(is_list for _, is_list in tables) else f"[{inner_path}]"
            if name == key:
                places.append(f"at the head of a table, {head}" if tables else place)
            # A table that may contain itself is looked at once.
            queue += [(inner_path, f"into {head}", (*within, inner)) for inner, _ in tables if inner not in within]
    return list(dict.fromkeys(places))


def _models_in(annotation: Any, *, is_list: bool = False) -> list[tuple[type[BaseModel], bool]]:
    """The models that a field may hold, and whether it holds a list of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [(annotation, is_list)]
    is_list = is_list or get_origin(annotation) in (list, tuple)
    return [found for part in get_args(annotation) for found in _models_in(part, is_list=is_list)]


def _model_at(model: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel]:
    """The model of the table at ``location``; of several kinds of tables the one whose name comes next there."""
    for part, kind in zip_longest(location, location[1:], fillvalue=""):
        if isinstance(part, int) or part not in model.model_fields:
            continue
        inner = [each for each, _ in _models_in(model.model_fields[part].annotation)]
        model = next((each for each in inner if _is_of_kind(each, kind)), inner[0] if inner else model)
    return model


def _is_of_kind(model: type[BaseModel], kind: int | str) -> bool:
    """Whether tables of a model are told from others by a key whose one value is ``kind``."""
    return any(get_args(field.annotation) == (kind,) for field in model.model_fields.values())


def _table_at(tables: Any, location: tuple[int | str, ...]) -> Mapping[str, Any]:
    """The table at ``location``, in which names of kinds of tables are no keys; empty: none."""
    for part in location:
        if isinstance(part, int) and isinstance(tables, list):
            tables = tables[part]
        elif isinstance(tables, Mapping):
            tables = tables.get(part, tables)
    return tables if isinstance(tables, Mapping) else {}


def _keys(model: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]
