# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects: what each adds to the reading, and its properties.

`form` defines what an effect is, `catalogue` lists those with a known cause, and `curves` makes
those without one.

An effect is one entry in `EFFECTS`. Simulation, fit, correction, search, report and documentation
read it from there, so an effect that is added here works in all of them. Its contribution to the
reading is a sum of terms

    added to axis i = Σ k_p · factor(context) · weight · monomial(u)

over the parameters k_p, with u the specific force in the sensor axes. The factor depends only on
the context, and the monomial only on the force. With the context fixed, a term with monomial 1
belongs to the offset V and a term with monomial u_j to the gain W. The other terms are nonlinear
in the force; they are called bending terms. The constants in which an effect is not linear, such
as a time constant, are its shape.

A temperature effect can have a lag [s]. With ``of_sensor`` 0 the die lags: the temperature that
acts is a low pass of the recorded one. With ``of_sensor`` 1 the temperature sensor lags: the
recorded temperature is a low pass of the one that acts (`accel_calib.thermal`).

Force, readings and standard deviations are in g, temperatures in °C, times in s. Names and terms
are those of IEEE 1293 (model equation of a linear accelerometer) and of data sheets.

"""

from .catalogue import (
    CHANGES,
    EFFECTS,
    LADDER,
    NOMINAL_SUPPLY,
    PROCESSES,
    REFERENCE_TEMPERATURE,
    WANDER,
)
from .curves import CARRIERS, EMPIRICAL, empirical, empirical_name, empirical_parts, VARIABLES
from .form import (
    AFFINE,
    AXES,
    by_axis,
    Context,
    CUBE,
    Effect,
    FORCE,
    MODES,
    MONOMIALS,
    ODD_SQUARE,
    ONE,
    PRODUCT,
    SIZE,
    SQUARE,
    TO_SEPARATE,
    WAVE,
)

__all__ = ['AFFINE', 'AXES', 'CARRIERS', 'CHANGES', 'CUBE', 'EFFECTS', 'EMPIRICAL', 'FORCE',
           'LADDER', 'MODES', 'MONOMIALS', 'NOMINAL_SUPPLY', 'ODD_SQUARE', 'ONE', 'PROCESSES',
           'PRODUCT', 'REFERENCE_TEMPERATURE', 'SIZE', 'SQUARE', 'TO_SEPARATE', 'VARIABLES',
           'WANDER', 'WAVE', 'Context', 'Effect', 'by_axis', 'effect_named', 'empirical_name',
           'empirical_parts', 'is_effect']


def is_effect(name: str) -> bool:
    """Return whether an effect has this name."""
    try:
        effect_named(name)
    except KeyError:
        return False
    return True


def effect_named(name: str) -> Effect:
    """Return the effect with this name: from the catalogue, or an empirical curve."""
    found = EFFECTS.get(name) or PROCESSES.get(name) or CHANGES.get(name)
    return found or empirical(name)
