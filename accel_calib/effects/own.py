# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects of a user: their definition, the guard around their functions, and how they become known.

A function of a user takes read-only copies of rows that are finite, and returns a finite number
for each row. It is called again with every other row: another answer shows that it depends on
something else than its arguments, or on other rows.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from inspect import Parameter, signature
from itertools import product
from pathlib import Path
import re
from typing import Any

import numpy as np

from .catalogue import effect_named, is_effect, OWN, parameter_names
from .form import AXES, Context, Effect, ONE, Term
from .model import terms_of
from .thermal import rate_at
from ..disk import check_regular
from ..errors import AccelCalibError, InputError, OwnEffectError
from ..table import column_of, Floats, is_quantity

_NAME = re.compile(r'[a-z][a-z0-9_]{0,63}')

_PROBED_G = np.linspace(-1.47, 1.53, 48)
_PROBE_STEP_G = 1e-6
_SLOPE_ERROR = 1e-3
"""Forces at which the slope of a form is compared with differences, and the largest error."""

_SAME = 1e-9
"""Relative difference between two answers of a function that count as the same."""

_ALL = 'all'
_COLUMNS = ('force', 'previous', 'rate', 'std', 'supply_voltage', 'temperature',
            'temperature_rate', 'time')
"""Columns that a function can take, besides quantities."""

_NEEDS = {'force': (), 'temperature_rate': ('time', 'temperature')}
"""Columns from which a column is computed."""

_TRIED = 60
_WIDE = 10.0
_SPREAD = (0.618034, 0.414214, 0.732051)
"""Number of starts of the constants; ratio of bounds above which they are spread by ratio; steps
of the further constants, irrational, so that few starts cover their ranges."""


_LONGEST = 300
"""Longest quoted message of an error [characters]."""


def _same(u: Any) -> Any:
    return u


@dataclass(frozen=True)
class OwnEffect:
    """
    An effect of a user: each axis reads k times a function more, with one k for each axis.

    The function is `function`, or in the simple form, form(u) · change(x).

    Parameters
    ----------
    name, words : str
        Name, of small letters, digits and ``_``, and short description.
    typical : float
        Typical size of k, in `unit`.
    unit : str
        Unit of k.
    form, slope : callable, optional
        Function of the force u along the axis [g], and its derivative by u, which is only
        compared with the form. Both take and return arrays. Without a form, it is 1.
    variable : str
        Column x that the effect is a function of; empty: of the force alone.
    change : callable
        Function of this column, from array to array; by default x itself.
    function : callable, optional
        Function whose arguments are named as columns or as `constants`. Columns are (n,) arrays,
        or (n, 3) for ``force`` [g], ``previous``, ``rate`` [rad/s] and ``std`` [g]; any other
        column of numbers is one, too. It returns an (n,) array, or (n, 3) for each axis.
    constants : mapping of str to (float, float)
        Lowest and highest value of each constant of `function`, which the fit finds.
    starts : mapping of str to sequence of float
        Values of constants from which the search starts; by default they are spread evenly.
    axes : str
        The axes that have the effect, each with its k, such as ``xy``; ``all``: with one k.

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
    change: Callable[[Any], Any] = _same
    function: Callable[..., Any] | None = None
    constants: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    starts: Mapping[str, Sequence[float]] = field(default_factory=dict)
    axes: str = ''.join(AXES)

    def __post_init__(self) -> None:
        columns = ', '.join(_COLUMNS)
        if not _NAME.fullmatch(str(self.name)):
            raise self._refused('has no usable name, expected small letters, digits and _')
        if not 0.0 < self.typical < np.inf:
            raise self._refused(f'has the typical size {self.typical}, expected a number above 0')
        if self.function is not None and (self.form is not None or self.variable):
            raise self._refused('has a function beside a form or a variable, expected one of them')
        if self.axes != _ALL and self.axes not in ('x', 'y', 'z', 'xy', 'xz', 'yz', 'xyz'):
            raise self._refused(f'has the axes {self.axes!r}, expected such as xyz, xy, z, or all')
        for key in self._columns:
            if key not in _COLUMNS and not is_quantity(key):
                raise self._refused(f'is a function of {key!r}, expected one of {columns}, the '
                                    'name of another column, or a constant')
        for name, bounds in self.constants.items():
            if name not in self._arguments or name in (*_COLUMNS, *AXES, _ALL):
                raise self._refused(f'has a constant {name!r}, which is no argument of its '
                                    'function, or the name of a column')
            if len(bounds) != 2 or not -np.inf < bounds[0] < bounds[1] < np.inf:
                raise self._refused(f'has the bounds {bounds} of {name}, expected two numbers, '
                                    'the lower one first')
        for name, starts in self.starts.items():
            low, high = self.constants.get(name, (np.nan, np.nan))
            if not len(starts) or not all(low <= start <= high for start in starts):
                raise self._refused(f'has the starts {starts} of {name}, expected numbers within '
                                    'the bounds of a constant')
        if self.function is not None and not self._columns:
            raise self._refused(f'has a function of no column, expected one of {columns}, or '
                                'the name of another column')
        if len(self.constants) > len(_SPREAD) + 1:
            raise self._refused(f'has {len(self.constants)} constants, expected at most 4')
        if self.slope is not None:
            self._check_slope(self.slope)

    def _check_slope(self, slope: Callable[[Any], Any]) -> None:
        if self.form is None:
            raise self._refused('has only one of form and slope, expected both or the form')
        near = np.stack([_PROBED_G + _PROBE_STEP_G, _PROBED_G - _PROBE_STEP_G])
        above, below = self._guarded('form', self.form, [near.ravel()]).reshape(near.shape)
        real = (above - below) / (2.0 * _PROBE_STEP_G)
        stated = self._guarded('slope', lambda u: np.broadcast_to(slope(u), u.shape),
                               [_PROBED_G])[:, 0]
        error = np.abs(stated - real) / np.maximum(np.abs(real), 1.0)
        worst = int(np.argmax(error))
        if not error[worst] < _SLOPE_ERROR:
            raise self._refused(f'has the slope {stated[worst]:.4g} at {_PROBED_G[worst]:.3g} g, '
                                f'expected {real[worst]:.4g}, the derivative of its form')

    def _refused(self, what: str) -> InputError:
        return InputError(f'the effect {self.name!r} {what}', 'correct its definition')

    @cached_property
    def _arguments(self) -> tuple[str, ...]:
        """Names of columns and constants, in the order in which `function` takes them."""
        if self.function is None:
            return (*(() if self.form is None else ('force',)), *filter(None, [self.variable]))
        try:
            given = signature(self.function).parameters.values()
        except (TypeError, ValueError) as err:
            raise self._refused('has a function whose arguments have no names, expected '
                                ' such as lambda temperature: …') from err
        required = [each for each in given if each.default is Parameter.empty]
        if any(each.kind not in (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
               for each in required):
            raise self._refused('has a function with arguments that cannot be given by position, '
                                'expected names of columns and constants')
        return tuple(each.name for each in required)

    @cached_property
    def _columns(self) -> tuple[str, ...]:
        return tuple(name for name in self._arguments if name not in self.constants)

    def entry(self) -> Effect:
        """Return the effect as the catalogue has them."""
        names = (_ALL,) if self.axes == _ALL else tuple(self.axes)
        over = tuple(key for key in self._columns if key != 'force')
        return Effect(
            self.words, 'own effect', names, self.unit, self.typical, 0.5,
            tuple(Term(0 if self.axes == _ALL else k, axis, ONE)
                  for k, axis in enumerate(self._places)),
            self._factor if self._columns else None,
            tuple(dict.fromkeys(need for key in over for need in _NEEDS.get(key, (key,)))),
            tuple(self.constants), self._shapes if self.constants else None, over=over,
            bounds=tuple(self.constants.values()), of_force='force' in self._columns, own=True)

    @cached_property
    def _places(self) -> list[int]:
        """Return the axes of the terms."""
        return [0, 1, 2] if self.axes == _ALL else [AXES.index(axis) for axis in self.axes]

    def _shapes(self, context: Context) -> Iterator[Floats]:
        """Yield values of the constants: each of the starts, with the others spread evenly."""
        given = [*product(*self.starts.values())]
        free = [name for name in self.constants if name not in self.starts]
        count = max(_TRIED // len(given), 1) if free else 1
        shares = np.outer(np.arange(count) + 0.5, [1.0 / count, *_SPREAD]) % 1.0
        for share, start in product(shares.tolist(), given):
            chosen = dict(zip(self.starts, start))
            for name, part in zip(free, share):
                low, high = self.constants[name]
                chosen[name] = (low * (high / low) ** part if 0.0 < low * _WIDE < high
                                else low + part * (high - low))
            yield np.array([chosen[name] for name in self.constants], float)

    def _factor(self, context: Mapping[str, Any], shape: Floats) -> Any:
        """Return the function of a context, as `form.Factor`; NaN where its context is NaN."""
        one = np.ndim(context[self._columns[0]]) < self._width(self._columns[0])
        known: dict[str, Any] = dict(zip(self.constants, map(float, shape)))
        for key in self._columns:
            value = rate_at(context) if key == 'temperature_rate' else context[key]
            known[key] = np.array(value, float, ndmin=self._width(key))
        if self.function is not None:
            found = self._guarded('function', self.function, [*map(known.get, self._arguments)])
        else:
            found = np.ones((1, 1))
            if self.form is not None:
                found = self._guarded('form', self.form, [known['force'].ravel()]).reshape(-1, 3)
            if self.variable:
                found = found * self._guarded('change', self.change, [known[self.variable]])
        factor = found[:, 0] if found.shape[1] == 1 else found.T[self._places]
        return factor[..., 0] if one else factor

    def _width(self, key: str) -> int:
        """Return the number of dimensions of a column."""
        return 2 if key == 'force' or len(column_of(key).names) > 1 else 1

    def _guarded(self, what: str, function: Callable[..., Any], given: Sequence[Any]) -> Floats:
        """Return the (n, 1) or (n, 3) numbers of a function, NaN where an argument is NaN."""
        columns = [each for each in given if isinstance(each, np.ndarray)]
        sound = np.all([np.isfinite(each.reshape(len(each), -1)).all(axis=1) for each in columns],
                       axis=0)
        if not np.any(sound):
            return np.full((len(sound), 1), np.nan)
        rows = _rows(given, sound)
        values = self._called(what, function, rows)
        again = self._called(what, function, _rows(rows, slice(None, None, 2)))
        if not np.allclose(again, values[::2], _SAME, _SAME * float(np.max(np.abs(values)))):
            raise self._wrong(what, 'returns other numbers for the same rows in another call',
                              'a function of each row alone')
        found = np.full((len(sound), values.shape[1]), np.nan)
        found[sound] = values
        return found

    def _called(self, what: str, function: Callable[..., Any], given: Sequence[Any]) -> Floats:
        """Return the finite (n, 1) or (n, 3) numbers of a function for copies of these rows."""
        copies = _rows(given, slice(None))
        count = max(np.shape(each)[0] for each in copies if np.ndim(each))
        try:
            with np.errstate(all='ignore'):  # what is not finite is refused below
                found = function(*copies)
                values = np.asarray(found)
        except (Exception, SystemExit) as err:
            raise self._wrong(what, f'raises {_said(err)}', 'numbers, and its arguments '
                              'left as they are') from err
        if values.dtype.kind not in 'fiub' or values.shape not in ((count,), (count, 3)):
            kind = (f'{values.dtype} of shape {values.shape}' if isinstance(found, np.ndarray)
                    else type(found).__name__)
            raise self._wrong(what, f'returns {kind}', f'real numbers of shape ({count},) or '
                              f'({count}, 3)')
        values = np.array(values.reshape(count, -1), float)
        lacking = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(lacking):
            shown = ', '.join(map(str, _rows(copies, lacking[0])))
            raise self._wrong(what, f'returns {values[lacking[0]]} for {shown}', 'a finite number')
        return values

    def _wrong(self, what: str, does: str, expected: str) -> OwnEffectError:
        return OwnEffectError(f'the {what} of the effect {self.name!r} {does}, expected '
                              f'{expected}', 'correct its definition')


def _rows(given: Sequence[Any], which: Any) -> list[Any]:
    """Return read-only copies of rows of the columns among arguments, and the constants."""
    found = [np.array(each[which]) if np.ndim(each) else each for each in given]
    for each in found:
        np.asarray(each).setflags(write=False)
    return found


def _said(error: BaseException) -> str:
    """Return kind and message of an error in code of a user, as one line."""
    text = f'{type(error).__name__}: {error}'[:_LONGEST]
    return ' '.join(''.join(each if each.isprintable() else ' ' for each in text).split())


def know(effects: Iterable[OwnEffect]) -> tuple[str, ...]:
    """
    Make effects of the user known to this process, instead of those of the same names.

    Return their names. Raise InputError for a name that the catalogue has.

    """
    names = []
    for own in effects:
        if is_effect(own.name) and own.name not in OWN:
            raise InputError(f'the effect {own.name!r} is in the catalogue', 'choose another name')
        OWN[own.name] = own.entry()
        names.append(own.name)
    effect_named.cache_clear()
    parameter_names.cache_clear()
    terms_of.cache_clear()
    return tuple(names)


def know_file(path: Path) -> tuple[str, ...]:
    """Execute a Python file as `know_code` does; raise OSError if it cannot be read."""
    check_regular(path)
    return know_code(str(path), path.read_bytes())


def know_code(name: str, code: bytes) -> tuple[str, ...]:
    """
    Make the own effects that the code of a file defines known, and return their names.

    The code is executed, unless this process has executed it. Raise InputError if it cannot be
    executed, or defines no effect.

    """
    if KNOWN_CODE.get(name) == code:
        return _DEFINED[name]
    defined: dict[str, Any] = {'__file__': name, '__name__': Path(name).stem}
    try:
        exec(compile(code, name, 'exec'), defined)
    except (AccelCalibError, OSError):
        raise
    except (Exception, SystemExit) as err:
        raise InputError(f'{name} cannot be executed ({_said(err)}), expected '
                         ' Python with own effects', 'correct it') from err
    found = {id(each): each for each in defined.values() if isinstance(each, OwnEffect)}
    if not found:
        raise InputError(f'{name} defines no effect, expected at least one accel_calib.Effect',
                         'see docs/effects.md for an example')
    _DEFINED[name] = know(found.values())
    KNOWN_CODE[name] = code
    return _DEFINED[name]


KNOWN_CODE: dict[str, bytes] = {}
"""Code of the files with own effects that this process has executed, for another process."""

_DEFINED: dict[str, tuple[str, ...]] = {}
"""Names of the effects of these files."""
