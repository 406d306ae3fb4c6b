# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Effects: what each adds to the reading, and its properties.

`form` defines what an effect is, and `catalogue` lists those with a known cause. `records` are
effects beyond the catalogue: curves, with their formulas for a paper or for firmware, and
covariates. `own` are those of a user, and `model` computes with a list of them. `thermal` finds
how the temperature lags and what it is between the steps of a thermometer, `history` how each pose
was reached, and `simulate` makes poses and recordings.

An effect is one entry in `EFFECTS`. Simulation, fit, correction, search, report and documentation
read it from there, so an effect that is added here works in all of them. Its contribution to the
reading is a sum of terms

    added to axis i = Σ k_p · factor(context) · weight · monomial(u)

over the parameters k_p, with u the specific force in the sensor axes. The factor depends only on
the context, and the monomial only on the force. With the context fixed, a term with monomial 1
belongs to the offset V and a term with monomial u_j to the gain W. The other terms are nonlinear
in the force; they are called bending terms. The constants in which an effect is not linear, such
as a time constant, are its shape. The gain of a ratiometric output, `supply_ratio`, scales the
gains of the other effects, too: it adds k · factor · W u in place of k · factor · u.

A temperature effect can have a lag [s]. With ``of_sensor`` 0 the die lags: the temperature that
acts is a low pass of the recorded one. With ``of_sensor`` 1 the temperature sensor lags: the
recorded temperature is a low pass of the one that acts (`accel_calib.effects.thermal`).

Force, readings and standard deviations are in g, temperatures in °C, times in s. Names and terms
are those of IEEE 1293 (model equation of a linear accelerometer) and of data sheets.

"""

from .catalogue import (
    CATALOGUE, CHANGES, EFFECTS, entry_of, included, LADDER, linear_values, ModelForm, MODELS,
    NOMINAL_SUPPLY, OFFSET_POWERS, parameter_names, ParameterName, PROCESSES,
    REFERENCE_TEMPERATURE, WANDER)
from .form import (
    AFFINE, AXES, by_axis, Context, CUBE, Effect, EffectKey, EffectRecord, fitted_places, FORCE,
    MONOMIALS, ODD_SQUARE, ONE, PRODUCT, SIZE, SQUARE, TO_SEPARATE, WAVE, ZONAL, ZONES)
from .history import (
    add_acting, add_history, context_of_samples, FROM_TEMPERATURE, TemperatureHistory,
    thermal_stream)
from .model import (
    check_context, CONVERGED_G, correct, EachShape, factors_of, LARGEST_FORCE_G,
    LARGEST_ITERATIONS, length_rows, linear_model, Model, own_slope, predict, sensor_force,
    terms_of, times, too_large, with_vector)
from .own import effects_of_file, own_effects, OwnEffect
from .records import (
    CARRIERS, Covariate, COVARIATES, curves_over, effect_named, EMPIRICAL, EmpiricalCurve,
    formula_of, kind_of, modes_of, shown_name, unchanged, unit_of, value_unit, variable_of,
    variable_words, VARIABLES)
from .simulate import model_with, parse_effect, simulate_poses, simulate_recording, turn_between
from .thermal import (
    acting_temperature, between_steps, covariance_of_steps, rate_at, step_of, ThermalStream)
