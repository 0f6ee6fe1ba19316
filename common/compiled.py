"""Kernels: loops over cells that Numba compiles to machine code, and the named records that they work on.

A frame of a small skin would take hundreds of NumPy calls of a microsecond each. A kernel does the same work for one
cell after the other. It is a function with type annotations under the decorator :func:`loop`. The first call compiles
it, or loads the machine code that an earlier process has left in ``__pycache__`` or in the user's cache. The logger
``ohmskin`` warns once in a process that has to compile.

A live stream need not wait for the compiler (:func:`compile_aside`): another process compiles, and kernels run as plain
Python until then.

Without machine code (:data:`SWITCH` or Numba's own :data:`NUMBA_SWITCH`) the same functions run as plain Python: the
same numbers, about a thousand times as slowly, for debugging and for tests. Kernels round as written: sums, products,
quotients and square roots follow IEEE 754 in the order of the source, and dividing by zero gives an infinity or NaN.

The state of a cell is a :class:`Record` with named fields; :class:`Records` is an array of these.
"""

from __future__ import annotations

import builtins
import hashlib
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Generic,
    ParamSpec,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np
from numpy.typing import NDArray

from .arrays import BoolArray, FloatArray, IntArray

SWITCH = "OHMSKIN_COMPILED"
"""environment variable; 0, no, off or false: kernels run as plain Python; checked: no call goes without a look at the
types of its arguments"""
NUMBA_SWITCH = "NUMBA_DISABLE_JIT"
"""Numba's own environment variable; 1: nothing is compiled"""
_NUMBA_FOLDER = "NUMBA_CACHE_DIR"
"""Numba's own environment variable for the folder of machine code"""
WAIT = "up to 30 s"
"""processor time in which all kernels are compiled"""

_OPTIONS: dict[str, bool | str] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""of Numba; C code calls no kernel"""
_UNCOUNTED = {"_nrt": False}
"""an option that Numba does not document: nobody counts references to arrays, which doubles what a call costs. Where a
kernel makes arrays, they must be counted"""
_MAKERS = {"empty", "zeros", "argsort"}
"""functions of NumPy that make arrays; no kernel may use another one"""
_SCALARS = {float: "float64", int: "intp", bool: "boolean", type(None): "void"}
_OFF, _CHECKED = ("0", "no", "off", "false"), "checked"
_log = logging.getLogger("ohmskin")
_lock = threading.RLock()
_offered: list[Loop[..., Any]] = []
_aside = threading.Event()
"""set while another process compiles, and kernels run as plain Python"""
_waiting: list[Loop[..., Any]] = []
"""kernels that are being compiled, or that wait for the compiler"""

P = ParamSpec("P")
R = TypeVar("R")


# -- types of arguments ------------------------------------------------------------------------------------------------


# Arrays whose elements are contiguous in memory, row after row.
Row = Annotated[FloatArray, "float64[::1]"]
Rows = Annotated[FloatArray, "float64[:, ::1]"]
Blocks = Annotated[FloatArray, "float64[:, :, ::1]"]
Reasons = Annotated[NDArray[np.int8], "int8[:, ::1]"]
Places = Annotated[IntArray, "intp[::1]"]
PlaceRows = Annotated[IntArray, "intp[:, ::1]"]
Flags = Annotated[BoolArray, "boolean[::1]"]
FlagRows = Annotated[BoolArray, "boolean[:, ::1]"]
# The same for arrays that the kernel does not write to, and that nobody may write to (flags.writeable is False).
# Only for such arrays: to find out that an array is not of exactly the stated type takes a call 0.3 us, and to look at
# one that nobody may write to 0.1 us more than at another.
FixedRow = Annotated[FloatArray, "Array(float64, 1, 'C', readonly=True)"]
FixedRows = Annotated[FloatArray, "Array(float64, 2, 'C', readonly=True)"]
FixedReasons = Annotated[NDArray[np.int8], "Array(int8, 2, 'C', readonly=True)"]


class Record:
    """Named state of one cell, or named parameters. A subclass annotates the fields and holds nothing else.

    A field is a ``float``, or a row of n of them: ``Annotated[FloatArray, n]``.
    """

    @classmethod
    @cache
    def dtype(cls) -> np.dtype[np.void]:
        """The layout in memory."""
        fields: list[Any] = []
        for name, hint in get_type_hints(cls, include_extras=True).items():
            fields.append(
                (name, np.float64, get_args(hint)[1]) if get_origin(hint) is Annotated else (name, np.float64)
            )
        return np.dtype(fields, align=True)


Kind = TypeVar("Kind", bound=Record)

if TYPE_CHECKING:

    class Records(np.ndarray[tuple[int], np.dtype[np.void]], Generic[Kind]):
        @overload  # type: ignore[override, no-overload-impl]
        def __getitem__(self, index: int | np.intp) -> Kind: ...
        @overload
        def __getitem__(self, index: str) -> FloatArray: ...
        @overload
        def __getitem__(self, index: IntArray | BoolArray | slice) -> Records[Kind]: ...

else:

    class Records(Generic[Kind]):
        """An array (n,) of records. ``records[i]`` is one of them, ``records["name"]`` (n,) is a field of all."""


def zeros(kind: type[Kind], count: int) -> Records[Kind]:
    """(count,) records whose fields are all zero."""
    # Of `np.record`, whose fields are also attributes, as kernels use them.
    return cast("Records[Kind]", np.zeros(count, np.dtype((np.record, kind.dtype()))))


def record(kind: type[Kind], **values: Any) -> Kind:
    """One record; every field has to be given."""
    if missing := set(kind.dtype().names or ()) ^ set(values):
        raise TypeError(f"{kind.__name__}: {', '.join(sorted(missing))} missing or unknown")
    found = zeros(kind, 1)
    for name, value in values.items():
        found[name] = value
    return found[0]


def values(records: Records[Any]) -> FloatArray:
    """(n, m) view of the m numbers of each record, in the order of the fields."""
    if not records.dtype.itemsize:
        return np.zeros((records.size, 0))
    return np.asarray(records).view(np.float64).reshape(records.size, -1)


def _numba() -> Any:
    """Numba, with machine code of the user's own only.

    Numba runs what it finds in its folder of machine code, and takes the name of that folder from a file in the working
    folder (``.numba_config.yaml``), too, which anybody may have written.
    """
    import numba

    numba.config.CACHE_DIR = os.environ.get(_NUMBA_FOLDER, "")
    return numba


# -- kernels -----------------------------------------------------------------------------------------------------------


def why_not() -> str | None:
    """Why no kernel is compiled, in a few words; None: they are compiled."""
    if _switch() in _OFF:
        return f"switched off by {SWITCH}={os.environ[SWITCH]}"
    return f"switched off by {NUMBA_SWITCH}" if _numba().config.DISABLE_JIT else None


def is_kept() -> bool:
    """Whether machine code is kept on disk for the next program; where :func:`why_not` says None.

    Otherwise no folder can be written to: neither ``__pycache__`` beside the modules nor one in the user's cache.
    """
    try:
        _numba().njit(cache=True)(_switch)  # compiles nothing yet, but looks for the folder
    except Exception:  # as in `Loop._compile`
        return False
    return True


class Loop(Generic[P, R]):
    """A kernel; see :func:`loop`."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.__module__, self.__qualname__ = function.__module__, function.__qualname__
        self.__doc__ = function.__doc__
        self.function = function
        """the function itself, as plain Python"""
        self._compiled: Any = None
        self.code: Callable[P, R] = self._first
        """the compiled function from the first use on"""
        self.unchecked: Callable[P, R] = self._first_unchecked
        """the same without a look at the types of the arguments, which takes half of a call: only for arrays that the
        caller has made itself, as others would be read as if they were of the stated types. Tests look at them
        nevertheless (:data:`SWITCH` is ``checked``)"""
        _offered.append(self)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.code(*args, **kwargs)

    def __reduce__(self) -> str:
        """For pickle and copy: the kernel of that name."""
        return self.__qualname__

    def load(self) -> None:
        """Compile the function, or load it from disk; at once where that has been done. Threads may call.

        The compiled function runs without the interpreter's lock. It takes positional arguments of exactly the types
        that the function states; others are refused with a TypeError, unless it is called :attr:`unchecked`.
        """
        if why_not() is not None:
            self.code = self.unchecked = self.function
        elif _aside.is_set():
            self.code = self.unchecked = self.plain()
        elif self._compiled is None:
            _waiting.append(self)
            try:
                with _lock:
                    self._compile()
            finally:
                _waiting.remove(self)

    def machine_code(self) -> Callable[P, R] | None:
        """The compiled function; None where kernels are switched off."""
        if why_not() is not None:
            return None
        self.load()
        return self.code

    def _first(self, *args: P.args, **kwargs: P.kwargs) -> R:
        self.load()
        return self.code(*args, **kwargs)

    def _first_unchecked(self, *args: P.args, **kwargs: P.kwargs) -> R:
        self.load()
        return self.unchecked(*args, **kwargs)

    @cache  # noqa: B019 - kernels live as long as the process
    def plain(self) -> Callable[P, R]:
        """The function as plain Python, and all that it calls."""
        function = cast(FunctionType, self.function)
        helpers = {name: value.plain() for name, value in self._globals().items() if isinstance(value, Loop)}
        names = {**function.__globals__, **helpers}
        return cast("Callable[P, R]", FunctionType(function.__code__, names, function.__name__, function.__defaults__))

    def is_on_disk(self) -> bool:
        """Whether machine code of this function is kept, as far as the name of a file tells."""
        named = FunctionType(cast(FunctionType, self.function).__code__, {}, self.function.__name__)
        named.__module__, named.__qualname__ = self.function.__module__, self._own_name()
        folder = _numba().njit(cache=True)(named).stats.cache_path
        return any(Path(folder).glob(f"*{self._own_name()}-*.nbc"))

    def _use(self, compiled: Any) -> None:
        self.code = compiled
        self.unchecked = compiled if _switch() == _CHECKED else _without_dispatcher(compiled)

    def _compile(self) -> Any:
        """The function as Numba compiled it, for calls and for other kernels, kept on disk if there is a place."""
        if self._compiled is None:
            try:
                compiled = self._compiled_by_numba(keep=True)
            except Exception:  # no folder to write to, a full disk, a damaged file
                compiled = self._compiled_by_numba(keep=False)
            if not compiled.stats.cache_hits:
                _tell_of_the_wait()
            if not _aside.is_set():
                self._use(compiled)
            self._compiled = compiled  # last: other threads take it for a sign that the others are there
        return self._compiled

    def _compiled_by_numba(self, *, keep: bool) -> Any:
        # The signature makes Numba compile at once, and for no other types: a stream never waits for the compiler.
        return _numba().njit(self._signature(), cache=keep, **self._options())(self._own_function())

    def _own_function(self) -> FunctionType:
        """A copy whose helpers are compiled functions, under a name that changes with all that it depends on.

        Numba knows a function on disk again by its name, file and code, but not by the numbers of other modules that
        were compiled into it.
        """
        plain = cast(FunctionType, self.function)
        helpers = {name: value._compile() for name, value in self._globals().items() if isinstance(value, Loop)}
        own = FunctionType(
            plain.__code__, {**plain.__globals__, **helpers}, plain.__name__, plain.__defaults__, plain.__closure__
        )
        own.__module__, own.__qualname__ = plain.__module__, self._own_name()
        return own

    def _own_name(self) -> str:
        return f"{cast(FunctionType, self.function).__qualname__}_{self._stamp()[:16]}"

    @cache  # noqa: B019 - kernels live as long as the process
    def _signature(self) -> Any:
        hints = get_type_hints(self.function, include_extras=True)
        answer = _numba_type(hints.pop("return"))
        return answer(*(_numba_type(hint) for hint in hints.values()))

    @cache  # noqa: B019 - kernels live as long as the process
    def _stamp(self) -> str:
        """Digest of the code, of the numbers and helpers that it uses, and of how it is compiled."""
        code = cast(FunctionType, self.function).__code__
        parts = [code.co_code.hex(), repr(code.co_consts), repr(code.co_names), str(self._signature())]
        parts.append(repr(self._options()))
        for name, value in sorted(self._globals().items()):
            parts.append(f"{name}={value._stamp() if isinstance(value, Loop) else value!r}")
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _options(self) -> dict[str, bool | str]:
        """Of Numba for this kernel; the undocumented one only where Numba knows it."""
        from numba.core import cpu

        if self._makes_arrays() or not hasattr(getattr(cpu, "CPUTargetOptions", None), "_nrt"):
            return _OPTIONS
        return _OPTIONS | _UNCOUNTED

    @cache  # noqa: B019 - kernels live as long as the process
    def _makes_arrays(self) -> bool:
        """Whether this kernel, or one that it calls, makes arrays."""
        makers = _MAKERS.intersection(cast(FunctionType, self.function).__code__.co_names)
        return bool(makers) or any(isinstance(used, Loop) and used._makes_arrays() for used in self._globals().values())

    def _globals(self) -> dict[str, Any]:
        """The helpers and numbers of the module that the function names.

        Raises:
            TypeError: the function uses something else, which a change on disk could not be told from.
        """
        function = cast(FunctionType, self.function)
        code, found = function.__code__, {}
        if code.co_freevars or any(isinstance(part, CodeType) for part in code.co_consts):
            raise TypeError(f"{function.__qualname__} uses a function within a function")
        for name in code.co_names:
            if name not in function.__globals__:
                continue  # of builtins, or an attribute
            value = function.__globals__[name]
            if isinstance(value, ModuleType) or (hasattr(builtins, name) and value is getattr(builtins, name)):
                continue
            if not isinstance(value, (Loop, bool, int, float)):
                raise TypeError(f"{function.__qualname__} uses {name}, which is neither a number nor a kernel")
            found[name] = value
        return found


@cache
def _tell_of_the_wait() -> None:
    """Warn once in a process why it waits: after the first kernel that was not on disk."""
    if is_kept():
        _log.warning("ohmskin compiles for this machine, only this once: %s of processor time", WAIT)
    else:
        _log.warning("ohmskin compiles, as no folder can keep machine code: %s; see `ohmskin doctor`", WAIT)


def compile_aside() -> bool:
    """Let another process compile the kernels of all imported modules; until then they run as plain Python.

    Returns:
        Whether that is so: not where kernels are switched off, kept on disk, or cannot be kept there.
    """
    if why_not() is not None or _aside.is_set() or not is_kept():
        return _aside.is_set()
    with _lock:
        missing = [each for each in _offered if each._compiled is None]
        if all(each.is_on_disk() for each in missing):
            return False
        try:
            process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, *dict.fromkeys(each.__module__ for each in missing)],
                cwd=Path(__file__).parent,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError:
            return False
        _aside.set()
        for each in missing:
            each.load()
    _log.warning("ohmskin compiles for this machine, only this once; frames come slowly until then, %s", WAIT)
    threading.Thread(target=_await, args=(process, missing), name="ohmskin compiler", daemon=True).start()
    return True


def is_aside() -> bool:
    """Whether another process compiles at present, and kernels run as plain Python."""
    return _aside.is_set()


_PROGRAM = """\
import importlib, sys
from ohmskin.common import compiled
for name in sys.argv[1:]:
    importlib.import_module(name)
compiled.load()
"""
"""what the other process does; it goes on if this one ends, so that the next one finds all"""


def _await(process: subprocess.Popen[bytes], missing: list[Loop[..., Any]]) -> None:
    """Take the machine code when it is there; where the other process has failed, compile it here."""
    process.wait()
    for each in missing:
        with _lock:
            each._compile()
    for each in missing:
        with _lock:
            each._use(each._compile())
    _aside.clear()


def loop(function: Callable[P, R]) -> Loop[P, R]:
    """Make a function of a module a kernel: a decorator.

    Its annotations are the types above, records, ``float``, ``int``, ``bool``, None, and tuples of these, named or not
    (``NamedTuple``: arrays that belong together are one argument). Beside its
    arguments it uses numbers of its module, the modules ``math`` and ``numpy``, and other kernels; within a function,
    no function. Calls are quickest where neither it nor the kernels that it calls make arrays (``numpy.empty``,
    ``numpy.zeros``).
    """
    return Loop(function)


def load(*loops: Loop[..., Any]) -> bool:
    """Compile kernels, or load what is kept on disk; without arguments those of all modules that have been imported.

    To be called before frames come, so that none has to wait.

    Returns:
        Whether they run as machine code.
    """
    for each in loops or tuple(_offered):
        each.load()
    return why_not() is None


def is_compiling() -> bool:
    """Whether the compiler is at work in some thread: who limits the time of other work does not count this time."""
    return bool(_waiting)


def _switch() -> str:
    return os.environ.get(SWITCH, "").strip().lower()


def _without_dispatcher(compiled: Any) -> Any:
    """What Numba's dispatcher calls once it has found out the types of the arguments; there is one signature only."""
    (only,) = compiled.overloads.values()
    return getattr(only, "entry_point", compiled)  # no part of what Numba promises


@cache
def _numba_type(hint: Any) -> Any:
    """The type that Numba has for a hint; kept, since records take it a millisecond each."""
    from numba import from_dtype, types

    if get_origin(hint) is Annotated:
        return eval(get_args(hint)[1], {}, vars(types))  # as Numba reads the signatures that it is given
    if get_origin(hint) is Records:
        return types.Array(from_dtype(get_args(hint)[0].dtype()), 1, "C")
    if get_origin(hint) is tuple:
        return types.Tuple([_numba_type(part) for part in get_args(hint)])
    if isinstance(hint, type) and issubclass(hint, Record):
        return from_dtype(hint.dtype())
    if isinstance(hint, type) and issubclass(hint, tuple):
        fields = get_type_hints(hint, include_extras=True).values()
        return types.NamedTuple([_numba_type(part) for part in fields], hint)
    return getattr(types, _SCALARS[hint])
