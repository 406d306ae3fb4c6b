# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects of a user: their definition, the guard around their functions, and the files with them.

A function of a user takes read-only copies of rows that are finite, and returns a finite number
for each row. It is called again with every other row: another answer shows that it depends on
something else than its arguments, or on other rows.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from inspect import Parameter, signature
from itertools import product
from pathlib import Path
import re
from typing import Any

import numpy as np

from .catalogue import CATALOGUE
from .form import AXES, Context, Effect, EffectRecord, ONE, Term
from .thermal import rate_at
from ..disk import check_regular
from ..errors import AccelCalibError, InputError, OwnEffectError
from ..table import column_of, Floats, is_quantity, read_only
from ..text import reason

_NAME = re.compile(r'[a-z][a-z0-9_]{0,63}')

_PROBED_G = np.linspace(-1.47, 1.53, 48)
_PROBE_STEP_G = 1e-6
_SLOPE_ERROR = 1e-3
"""Forces at which the slope of a form is compared with differences, and the largest error."""

_SAME = 1e-9
"""Relative difference of two answers of a function that count as the same."""

_ALL = 'all'
_COLUMNS = ('duration', 'force', 'previous', 'rate', 'since_turn', 'std', 'supply_voltage',
            'temperature', 'temperature_rate', 'time')
"""Columns that a function can take, besides quantities."""

_NEEDS = {'temperature_rate': ('time', 'temperature')}
"""Columns from which a column is computed."""

_TRIED = 60
_WIDE = 10.0
_STEPS = (0.618034, 0.414214, 0.732051)
"""Number of starts of the constants; ratio of bounds above which they are spread by ratio; steps
of the further constants, irrational, so that few starts cover their ranges."""


@dataclass(frozen=True, eq=False)
class OwnEffect(EffectRecord):
    """
    An effect of a user: each axis reads k · function more, or k · form(u) · change(x).

    Two are equal if they come from the same file, or have the same parts.

    Parameters
    ----------
    name, words : str
        Name, of small letters, digits and ``_``, and short description.
    typical : float
        Typical size of k, in `unit`.
    unit : str
        Unit of k.
    form, slope : callable, optional
        Function of the force u along the axis [g], from array to array, and its derivative by u,
        with which it is compared; by default 1.
    variable : str
        Column x that the effect is a function of; empty: of the force alone.
    change : callable
        Function of this column, from array to array; by default x itself.
    function : callable, optional
        Function whose arguments are named as columns or `constants`. A column is an (n,) array,
        or (n, 3) for ``force`` [g], ``previous``, ``rate`` [rad/s] and ``std`` [g]. It returns an
        (n,) array, or (n, 3) by axis.
    constants : mapping of str to sequence of float
        Lowest and highest value of each constant, which the fit finds; then starts of the search,
        by default spread evenly.
    axes : str
        The axes with the effect, each with its k, such as ``xy``; ``all``: with one k.

    Raises
    ------
    InputError
        If a part is not usable, or the slope is not the derivative of the form.

    """

    name: str
    words: str
    typical: float
    unit: str = 'g'
    form: Callable[[Any], Any] | None = None
    slope: Callable[[Any], Any] | None = None
    variable: str = ''
    change: Callable[[Any], Any] | None = None
    function: Callable[..., Any] | None = None
    constants: Mapping[str, Sequence[float]] = field(default_factory=dict)
    axes: str = ''.join(AXES)
    source: tuple[str, bytes] | None = field(default=None, init=False, repr=False)
    """Name and content of the file that defines the effect, by which it is pickled."""

    def __post_init__(self) -> None:
        if self.name in CATALOGUE:
            raise InputError(f'the effect {self.name!r} is in the catalogue',
                             'choose another name')
        simple, taken = self.form is not None or self.variable, (*_COLUMNS, *AXES, _ALL)
        self._check(bool(_NAME.fullmatch(self.name)),
                    'has no usable name, expected small letters, digits and _')
        self._check(0.0 < self.typical < np.inf,
                    f'has the typical size {self.typical}, expected a number above 0')
        self._check(not (self.function and simple), 'has both a function and a form or variable, '
                    'expected one of them')
        self._check(self.slope is None or self.form is not None,
                    'has only one of form and slope, expected both or the form')
        self._check(self.axes == _ALL or [*self.axes] == [each for each in AXES
                                                          if each in self.axes] != [],
                    f'has the axes {self.axes!r}, expected axes such as xyz or z, or all')
        for name in self._columns:
            self._check(name in _COLUMNS or is_quantity(name), f'is a function of {name!r}, '
                        f'expected a constant, one of {", ".join(_COLUMNS)}, or another column')
        self._check(self.function is None or len(self._columns) > 0,
                    'has a function without a column, expected an argument such as temperature')
        self._check(len(self.constants) <= len(_STEPS) + 1, 'has too many constants, expected 4')
        arguments = {name for _, _, names in self._calls for name in names}
        for name, numbers in self.constants.items():
            self._check(name in arguments and name not in taken, 'has a constant '
                        f'{name!r}, expected an argument of its function that is no column')
            self._check(len(numbers) > 1 and -np.inf < numbers[0] < numbers[1] < np.inf
                        and all(numbers[0] <= start <= numbers[1] for start in numbers[2:]),
                        f'has {numbers} for {name}, expected the lowest and the highest value, '
                        'then starts between them')
        if self.form is not None and self.slope is not None:
            above, below, slope = (self._guarded(what, function, (_PROBED_G + step,))[:, 0]
                                   for what, function, step in (
                ('form', self.form, _PROBE_STEP_G), ('form', self.form, -_PROBE_STEP_G),
                ('slope', lambda u: np.broadcast_to(self.slope(u), u.shape), 0.0)))
            real = (above - below) / (2.0 * _PROBE_STEP_G)
            error = np.abs(slope - real) / np.maximum(np.abs(real), 1.0)
            worst = int(np.argmax(error))
            self._check(bool(error[worst] < _SLOPE_ERROR), f'has the slope {slope[worst]:.4g} at '
                        f'{_PROBED_G[worst]:.3g} g, expected {real[worst]:.4g}, the derivative of '
                        'its form')

    def _check(self, is_sound: bool, else_: str) -> None:
        if not is_sound:
            raise InputError(f'the effect {self.name!r} {else_}', 'correct its definition')

    def __str__(self) -> str:
        return self.name

    @property
    def _parts(self) -> tuple[Any, ...]:
        return tuple(getattr(self, each.name) for each in fields(self) if each.init)

    def __eq__(self, other: object) -> bool:
        return (isinstance(other, OwnEffect) and self.name == other.name
                and self.source == other.source
                and (self.source is not None or self._parts == other._parts))

    def __hash__(self) -> int:
        return hash(self.name)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make the effect again: functions of a file cannot be pickled."""
        return (_of_file, (*self.source, self.name)) if self.source else (OwnEffect, self._parts)

    @cached_property
    def _calls(self) -> tuple[tuple[str, Callable[..., Any], tuple[str, ...]], ...]:
        """Return the factors of the effect: kind, function, names of its arguments."""
        if self.function is None:
            return tuple((what, function, (name,)) for what, function, name in (
                ('form', self.form, 'force'),
                ('change', self.change or np.positive, self.variable)) if function and name)
        try:
            given = [*signature(self.function).parameters.values()]
        except (TypeError, ValueError):
            given = []
        names = tuple(each.name for each in given if each.default is Parameter.empty and each.kind
                      in (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD))
        return (('function', self.function, names),)

    @cached_property
    def _columns(self) -> tuple[str, ...]:
        return tuple(name for _, _, names in self._calls for name in names
                     if name not in self.constants)

    @cached_property
    def entry(self) -> Effect:
        over = tuple(key for key in self._columns if key != 'force')
        axes = [k for k, axis in enumerate(AXES) if axis in self.axes or self.axes == _ALL]
        return Effect(
            words=self.words, term='own effect', unit=self.unit, typical=self.typical,
            parameters=(_ALL,) if self.axes == _ALL else tuple(self.axes),
            terms=tuple(Term(k * (self.axes != _ALL), axis, ONE) for k, axis in enumerate(axes)),
            factor=self._factor if self._columns else None, over=over,
            needs=tuple(dict.fromkeys(need for key in over for need in _NEEDS.get(key, (key,)))),
            shape=tuple(self.constants), shapes=self._shapes if self.constants else None,
            bounds=tuple((low, high) for low, high, *_ in self.constants.values()),
            of_force='force' in self._columns, own=True)

    def _shapes(self, context: Context) -> Iterator[Floats]:
        """Yield values of the constants: the starts, with the other constants spread evenly."""
        numbers = self.constants.values()
        low, high = np.array([[*each[:2]] for each in numbers], float).T
        starts = np.array([*product(*(each[2:] or (np.nan,) for each in numbers))], float)
        count = max(_TRIED // len(starts), 1) if np.any(np.isnan(starts)) else 1
        share = np.outer(np.arange(count) + 0.5, [1.0 / count, *_STEPS][:len(low)]) % 1.0
        wide = (low > 0.0) & (high > _WIDE * low)
        first, last = np.where(wide, [low, high], 1.0)
        spread = np.where(wide, first * (last / first) ** share, low + share * (high - low))
        yield from np.where(np.isnan(starts), spread[:, np.newaxis], starts).reshape(-1, len(low))

    def _factor(self, context: Mapping[str, Any], shape: Floats) -> Any:
        """Return the product of the functions, as `form.Factor`; NaN where an argument is NaN."""
        known: dict[str, Any] = dict(zip(self.constants, shape.tolist()
                                         if isinstance(shape, np.ndarray) else shape))
        for key in self._columns:
            value = rate_at(context) if key == 'temperature_rate' else context[key]
            width = 2 if key == 'force' or len(column_of(key).names) > 1 else 1
            one = np.ndim(value) < width
            known[key] = np.array(value, float, ndmin=width)
        found = np.ones((1, 1))
        for what, function, names in self._calls:
            found = found * self._guarded(what, function, [known[name] for name in names])
        factor = found[:, 0] if found.shape[1] == 1 else found.T[[
            term.axis for term in self.entry.terms]]
        return factor[..., 0] if one else factor

    def _guarded(self, what: str, function: Callable[..., Any], given: Sequence[Any]) -> Floats:
        """Return the (n, 1) or (n, 3) numbers of a function, NaN where an argument is NaN."""
        sound = np.all([np.isfinite(each).reshape(len(each), -1).all(axis=1)
                        for each in given if np.ndim(each)], axis=0)
        if not np.any(sound):
            return np.full((len(sound), 1), np.nan)
        rows = _rows(given, sound)
        values = self._called(what, function, rows)
        if len(sound) == 1:  # a message, for which a second answer takes too long
            return values
        again = self._called(what, function, _rows(rows, slice(None, None, 2)))
        if not np.allclose(again, values[::2], _SAME, _SAME * float(np.max(np.abs(values)))):
            raise self._wrong(what, 'returns other numbers for the same rows in another call',
                              'a function of each row alone')
        found = np.full((len(sound), values.shape[1]), np.nan)
        found[sound] = values
        return found

    def _called(self, what: str, function: Callable[..., Any], given: Sequence[Any]) -> Floats:
        """Return the finite (n, 1) or (n, 3) numbers of a function for these rows."""
        count = next(len(each) for each in given if np.ndim(each))
        try:
            with np.errstate(all='ignore'):  # what is not finite is refused below
                found = function(*given)
                values = np.asarray(found)
        except (Exception, SystemExit) as err:
            raise self._wrong(what, f'fails ({reason(err)})', 'numbers, and its arguments left as '
                              'they are') from err
        if values.dtype.kind not in 'fiub' or values.shape not in ((count,), (count, 3)):
            kind = (f'{values.dtype} of shape {values.shape}' if isinstance(found, np.ndarray)
                    else type(found).__name__)
            raise self._wrong(what, f'returns {kind}', f'real numbers of shape ({count},) or '
                              f'({count}, 3)')
        values = np.array(values.reshape(count, -1), float)
        lacking = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(lacking):
            shown = ', '.join(map(str, _rows(given, lacking[0])))
            raise self._wrong(what, f'returns {values[lacking[0]]} for {shown}', 'a finite number')
        return values

    def _wrong(self, what: str, does: str, expected: str) -> OwnEffectError:
        return OwnEffectError(f'the {what} of the effect {self.name!r} {does}, expected '
                              f'{expected}', 'correct its definition')


def _rows(given: Sequence[Any], which: Any) -> list[Any]:
    """Return read-only copies of rows of the columns among arguments, and the constants."""
    return [read_only(np.array(each[which])) if np.ndim(each) else each for each in given]


def own_effects(effects: Iterable[OwnEffect]) -> tuple[OwnEffect, ...]:
    """Return effects without those that a later one of the same name replaces."""
    return tuple({each.name: each for each in effects}.values())


def effects_of_file(path: Path) -> tuple[OwnEffect, ...]:
    """Execute a Python file as `effects_of_code` does; raise OSError if it cannot be read."""
    check_regular(path)
    return effects_of_code(str(path), path.read_bytes())


@lru_cache(maxsize=16)
def effects_of_code(name: str, code: bytes) -> tuple[OwnEffect, ...]:
    """
    Return the own effects that the code of a file defines.

    The code is executed, unless this process has just executed it. Raise InputError if it cannot
    be executed, or defines no effect.

    """
    defined: dict[str, Any] = {'__file__': name, '__name__': Path(name).stem}
    try:
        exec(compile(code, name, 'exec'), defined)
    except (AccelCalibError, OSError):
        raise
    except (Exception, SystemExit) as err:
        raise InputError(f'{name} cannot be executed ({reason(err)}), expected '
                         'Python with own effects', 'correct it') from err
    found = [replace(each) for each in defined.values() if isinstance(each, OwnEffect)]
    if not found:
        raise InputError(f'{name} defines no effect, expected at least one accel_calib.Effect',
                         'see docs/effects.md for an example')
    for each in found:
        object.__setattr__(each, 'source', (name, code))
    return own_effects(found)


def _of_file(name: str, code: bytes, effect: str) -> OwnEffect:
    """Return an effect that is unpickled."""
    return next(each for each in effects_of_code(name, code) if each.name == effect)
