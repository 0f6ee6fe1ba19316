"""Just-in-time compilation of loops over cells to machine code, by Numba, where the extra ``fast`` is installed.

An array operation of NumPy costs about a microsecond, however few cells there are, and a frame of a small skin takes
hundreds of them. A loop that does the same work for one cell after the other takes a few microseconds as machine code.
So a room writes such work twice: as array operations, which always run, and as a :class:`Loop`, which runs only
compiled. The array operations are the reference of the loops' tests.

A loop rounds as the array operations do: sums, products, quotients and square roots follow IEEE 754, in the order in
which they are written, and dividing by zero gives an infinity or NaN.

Compiling takes seconds, importing Numba a quarter of one. So nothing happens until somebody asks for the machine code
(:meth:`Loop.machine_code`), which is kept on disk for the next process, in ``__pycache__`` or in the user's cache. The
logger ``ohmskin`` warns once in a process that has to compile. Python shows warnings on standard error, unless the
program has set up another place for them.
"""

from __future__ import annotations

import builtins
import hashlib
import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from types import CodeType, FunctionType, ModuleType
from typing import Annotated, Any, Generic, ParamSpec, TypeVar, cast, get_args, get_origin, get_type_hints

from .arrays import BoolArray, CodeArray, FloatArray, IntArray

SWITCH = "OHMSKIN_COMPILED"
"""environment variable; 0, no, off or false: no machine code is used, though Numba is installed; checked: no call goes
without a look at the types of its arguments"""
NUMBA_SWITCH = "NUMBA_DISABLE_JIT"
"""Numba's own environment variable, by which programs that use Numba are debugged; 1: nothing is compiled"""

# Types of a loop's arguments: arrays whose elements are contiguous in memory, row after row.
Row = Annotated[FloatArray, "float64[::1]"]
Rows = Annotated[FloatArray, "float64[:, ::1]"]
Places = Annotated[IntArray, "intp[::1]"]
Flags = Annotated[BoolArray, "boolean[::1]"]
# Rows that need not follow each other without a gap, since there are many of them (`ohmskin.common.arrays.spaced`).
SpacedRows = Annotated[FloatArray, "float64[:, :]"]
SpacedPlaces = Annotated[IntArray, "intp[:, :]"]
FlagRows = Annotated[BoolArray, "boolean[:, ::1]"]
Codes = Annotated[CodeArray, "uint32[::1]"]
# The same for arrays that the loop does not write to, and that nobody may write to (flags.writeable is False).
# Only for such arrays: to find out that an array is not of exactly the stated type takes a call 0.3 us, and to look at
# one that nobody may write to 0.1 us more than at another.
FixedRow = Annotated[FloatArray, "Array(float64, 1, 'C', readonly=True)"]
FixedRows = Annotated[FloatArray, "Array(float64, 2, 'C', readonly=True)"]
FixedFlags = Annotated[BoolArray, "Array(boolean, 1, 'C', readonly=True)"]
FixedCodes = Annotated[CodeArray, "Array(uint32, 1, 'C', readonly=True)"]

WAIT = "up to 60 s"
"""processor time in which all loops, more than eighty, are compiled on a slow core; a fast one takes half as long"""

_OPTIONS: dict[str, bool | str] = {"nogil": True, "error_model": "numpy"}
"""of Numba, for all loops"""
_INLINED, _UNCOUNTED = {"forceinline": True}, {"_nrt": False}
"""options beside that Numba does not document. By the first a loop becomes a part of those that call it: a call for
each cell would take as long as the work that is done there. By the second nobody counts references to arrays, which
doubles what a call costs; where a loop makes arrays, they must be counted"""
_MAKERS = {"empty", "zeros"}
"""functions of NumPy that make arrays; no loop may use another one"""
_SCALARS = {float: "float64", int: "intp", bool: "boolean", type(None): "void"}
_OFF, _CHECKED = ("0", "no", "off", "false"), "checked"
_log = logging.getLogger("ohmskin")
_lock = threading.RLock()
_offered: list[Loop[..., Any]] = []
_waiting: list[Loop[..., Any]] = []
"""loops that are being compiled, or that wait for the compiler"""

P = ParamSpec("P")
R = TypeVar("R")


def why_not() -> str | None:
    """Why no loop is compiled, in a few words; None: loops are compiled."""
    if _switch() in _OFF:
        return f"switched off by {SWITCH}={os.environ[SWITCH]}"
    try:
        import numba
    except Exception as error:  # one that does not fit this NumPy or Python raises whatever it likes
        if isinstance(error, ModuleNotFoundError) and error.name == "numba":
            return "numba is not installed"
        return f"numba cannot be imported: {error}"
    if not hasattr(numba, "njit"):
        return "numba is not the compiler of that name"
    # Numba would then give back the function itself, which is far slower than array operations.
    return f"switched off by {NUMBA_SWITCH}" if getattr(numba, "config", None) and numba.config.DISABLE_JIT else None


def is_kept() -> bool:
    """Whether machine code is kept on disk for the next program; where :func:`why_not` says None.

    Otherwise no folder can be written to: neither ``__pycache__`` beside the modules nor one in the user's cache.
    """
    import numba

    try:
        numba.njit(cache=True)(_written)  # compiles nothing yet, but looks for the folder
    except Exception:  # as in `Loop._compile`
        return False
    return True


class Loop(Generic[P, R]):
    """A function of a module that works on arrays element by element, to be compiled; see :func:`loop`."""

    def __init__(self, function: Callable[P, R]) -> None:
        self.__module__, self.__qualname__ = function.__module__, function.__qualname__
        self.__doc__ = function.__doc__
        self.function = function
        """the function itself: the same answers, about a thousand times as slow"""
        self.failure: str | None = None
        """why the compiler refused the function; None: it did not, or was not asked yet"""
        self._compiled: Any = None
        _offered.append(self)
        self.code: Callable[P, R] = function
        """the compiled function once :func:`load` said so, before that ``function``"""
        self.unchecked: Callable[P, R] = function
        """the same without a look at the types of the arguments, which takes half of a call: only for arrays that the
        caller has made itself, as others would be read as if they were of the stated types. Tests look at them
        nevertheless (:data:`SWITCH` is ``checked``)"""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        return self.code(*args, **kwargs)

    def __reduce__(self) -> str:
        """For pickle and copy: the loop of that name."""
        return self.__qualname__

    def machine_code(self, *, unchecked: bool = False) -> Callable[P, R] | None:
        """The compiled function, or None where there is none: ask when an object is made, not for every frame.

        The first call loads the machine code from disk, or compiles for a second or so; later ones return at once.
        Threads may call, and the compiled function runs without the interpreter's lock. It takes positional arguments
        of exactly the types that the function states: others are refused with a TypeError, unless :attr:`unchecked` is
        asked for.
        """
        if why_not() is not None:
            return None
        if self._compiled is None and self.failure is None:
            _waiting.append(self)
            try:
                with _lock:
                    self._compile()
            except Exception as error:  # of any part of the compiler
                self.failure = f"{type(error).__name__}: {error}"
            finally:
                _waiting.remove(self)
        if self._compiled is None:
            return None
        return self.unchecked if unchecked else self.code

    def _compile(self) -> Any:
        """The function as Numba compiled it, for calls and for other loops, kept on disk if there is a place for it."""
        if self._compiled is None:
            try:
                compiled = self._compiled_by_numba(keep=True)
            except Exception:  # no folder to write to, a full disk, a damaged file
                compiled = self._compiled_by_numba(keep=False)
            if not compiled.stats.cache_hits:
                _tell_of_the_wait()
            self.code = compiled
            self.unchecked = compiled if _switch() == _CHECKED else _without_dispatcher(compiled)
            self._compiled = compiled  # last: other threads take it for a sign that the others are there
        return self._compiled

    def _compiled_by_numba(self, *, keep: bool) -> Any:
        import numba

        # The signature makes Numba compile at once, and for no other types: a stream never waits for the compiler.
        return numba.njit(self._signature(), cache=keep, **self._options())(self._own_function())

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
        own.__module__, own.__qualname__ = plain.__module__, f"{plain.__qualname__}_{self._stamp()[:16]}"
        return own

    def _signature(self) -> str:
        """The types as Numba writes them, from the annotations."""
        hints = get_type_hints(self.function, include_extras=True)
        answer = _written(hints.pop("return"))
        return f"{answer}({', '.join(_written(hint) for hint in hints.values())})"

    def _stamp(self) -> str:
        """Digest of the code, of the numbers and helpers that it uses, and of how it is compiled."""
        code = cast(FunctionType, self.function).__code__
        parts = [code.co_code.hex(), repr(code.co_consts), repr(code.co_names), self._signature()]
        parts.append(repr(self._options()))
        for name, value in sorted(self._globals().items()):
            parts.append(f"{name}={value._stamp() if isinstance(value, Loop) else value!r}")
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _options(self) -> dict[str, bool | str]:
        """Of Numba for this loop; undocumented ones only where Numba knows them."""
        from numba.core import cpu

        beside = _INLINED if self._makes_arrays() else _INLINED | _UNCOUNTED
        known = getattr(cpu, "CPUTargetOptions", None)
        return _OPTIONS | {name: value for name, value in beside.items() if hasattr(known, name)}

    def _makes_arrays(self) -> bool:
        """Whether this loop, or one that it calls, makes arrays."""
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
                raise TypeError(f"{function.__qualname__} uses {name}, which is neither a number nor a loop")
            found[name] = value
        return found


@cache
def _tell_of_the_wait() -> None:
    """Warn once in a process why it waits: after the first loop that was not on disk, with some fifty to come."""
    if is_kept():
        _log.warning("ohmskin[fast] compiles for this machine, only this once: %s of processor time", WAIT)
    else:
        _log.warning("ohmskin[fast] compiles, as no folder can keep machine code: %s; see `ohmskin doctor`", WAIT)


def loop(function: Callable[P, R]) -> Loop[P, R]:
    """Offer a function of a module for compilation: a decorator.

    Its annotations are the types above, ``float``, ``int``, ``bool``, None, and tuples of these. Beside its arguments
    it uses numbers of its module, the modules ``math`` and ``numpy``, and other loops; within a function, no function.
    Calls are quickest where neither it nor the loops that it calls make arrays (``numpy.empty``, ``numpy.zeros``).
    """
    return Loop(function)


def load(*loops: Loop[..., Any]) -> bool:
    """Compile loops, or load what is kept on disk; without arguments those of all modules that have been imported.

    To be called when an object is made whose frames are to be quick, and before anything is waited for.

    Returns:
        Whether all of them are there as machine code, in ``Loop.code``. If not, array operations are to do the work.
    """
    if why_not() is not None:
        return False
    return all([each.machine_code() is not None for each in loops or tuple(_offered)])


@contextmanager
def switched_off() -> Iterator[None]:
    """Make what is made meanwhile do its work by array operations: to compare."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "off"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SWITCH]
        else:
            os.environ[SWITCH] = before


def is_compiling() -> bool:
    """Whether the compiler is at work in some thread: who limits the time of other work does not count this time."""
    return bool(_waiting)


def _switch() -> str:
    return os.environ.get(SWITCH, "").strip().lower()


def _without_dispatcher(compiled: Any) -> Any:
    """What Numba's dispatcher calls once it has found out the types of the arguments; there is one signature only."""
    (only,) = compiled.overloads.values()
    return getattr(only, "entry_point", compiled)  # no part of what Numba promises


def _written(hint: Any) -> str:
    """A type as Numba writes it."""
    if get_origin(hint) is Annotated:
        return str(get_args(hint)[1])
    if get_origin(hint) is tuple:
        return f"Tuple(({', '.join(_written(part) for part in get_args(hint))}))"
    return _SCALARS[hint]
