# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Effects of a user: their definition, and how a process comes to know them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import re
from typing import Any

import numpy as np

from .catalogue import effect_named, is_effect, OWN, parameter_names
from .form import AXES, by_axis, each_axis, Effect, Monomial, MONOMIALS, ONE
from .model import terms_of
from ..disk import check_regular
from ..errors import AccelCalibError, InputError
from ..table import is_quantity

_NAME = re.compile(r'[a-z][a-z0-9_]{0,63}')

_PROBED_G = np.linspace(-1.47, 1.53, 48)
_PROBE_STEP_G = 1e-6
_SLOPE_ERROR = 1e-3
"""Forces at which the slope of a form is compared with differences, and the largest error."""


def _same(u: Any) -> Any:
    return u


@dataclass(frozen=True)
class OwnEffect:
    """
    An effect of a user: each axis reads k · form(u) · change(x) more, with one k for each axis.

    Parameters
    ----------
    name, words : str
        Name, of small letters, digits and ``_``, and short description.
    typical : float
        Typical size of k, in `unit`.
    unit : str
        Unit of k.
    form, slope : callable, optional
        Function of the force u along the axis [g], and its derivative by u. Both take and return
        arrays. Without them, form is 1: an offset.
    variable : str
        Column x that the effect is a function of; empty: of the force alone.
    change : callable
        Function of this column, from array to array; by default x itself.

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

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise self._refused('has no usable name, expected small letters, digits and _')
        if not 0.0 < self.typical < np.inf:
            raise self._refused(f'has the typical size {self.typical}, expected a number above 0')
        if (self.form is None) is not (self.slope is None):
            raise self._refused('has only one of form and slope, expected both or none')
        if self.variable and not is_quantity(self.variable) and self.variable not in _ALONE:
            raise self._refused(f'is a function of {self.variable!r}, expected one of '
                                f'{", ".join(_ALONE)}, or the name of another column')
        if self.form is None or self.slope is None:
            return
        stated = np.broadcast_to(self.slope(_PROBED_G), _PROBED_G.shape)
        real = (self.form(_PROBED_G + _PROBE_STEP_G) - self.form(_PROBED_G - _PROBE_STEP_G)) / (
            2.0 * _PROBE_STEP_G)
        error = np.abs(stated - real) / np.maximum(np.abs(real), 1.0)
        worst = int(np.argmax(error))
        if not error[worst] < _SLOPE_ERROR:
            raise self._refused(f'has the slope {stated[worst]:.4g} at {_PROBED_G[worst]:.3g} g, '
                                f'expected {real[worst]:.4g}, the derivative of its form')

    def _refused(self, what: str) -> InputError:
        return InputError(f'the effect {self.name!r} {what}', 'correct its definition')

    def entry(self, first: int) -> Effect:
        """Return the effect, with the index of the first of its `monomials`."""
        effect = partial(Effect, self.words, 'own effect', AXES, self.unit, self.typical, 0.5,
                         by_axis(ONE if self.form is None else first), own=True)
        if not self.variable:
            return effect()
        return effect(factor=lambda context, shape: self.change(context[self.variable]),
                      needs=(self.variable,))

    @property
    def monomials(self) -> list[Monomial]:
        """Return the form by axis, to be added to `MONOMIALS`; empty for an offset."""
        return [] if self.form is None or self.slope is None else each_axis(self.form, self.slope)


_ALONE = ('time', 'temperature', 'supply_voltage')
"""Columns of one number that an own effect can be a function of, besides quantities."""


def know(effects: Iterable[OwnEffect]) -> tuple[str, ...]:
    """
    Make effects of the user known to this process, instead of those of the same names.

    Return their names. Raise InputError for a name that the catalogue has.

    """
    names = []
    for own in effects:
        if is_effect(own.name) and own.name not in OWN:
            raise InputError(f'the effect {own.name!r} is in the catalogue', 'choose another name')
        OWN[own.name] = own.entry(len(MONOMIALS))
        MONOMIALS.extend(own.monomials)
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
    except Exception as err:
        raise InputError(f'{name} cannot be executed ({type(err).__name__}: {err}), expected '
                         'Python with own effects', 'correct it') from err
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
