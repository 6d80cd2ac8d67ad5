"""Parameter spaces: vectors in the order given, and what may not be a parameter."""

import dataclasses
import pickle

import numpy as np
import pytest

from phytofit.errors import SettingError
from phytofit.parameters import Parameter, ParameterSpace

WIDTH = Parameter("leaf_width", "cm", mean=6.0, std=2.0, lower=0.3)
ANGLE = Parameter("leaf_angle", "deg", mean=45.0, std=20.0, lower=0.0, upper=180.0)


def test_vectors_follow_the_order_of_the_parameters():
    space = ParameterSpace([WIDTH, ANGLE])
    assert len(space) == 2
    assert space.names == ("leaf_width", "leaf_angle")
    assert space.units == ("cm", "deg")
    np.testing.assert_array_equal(space.mean, [6.0, 45.0])
    np.testing.assert_array_equal(space.std, [2.0, 20.0])
    np.testing.assert_array_equal(space.lower, [0.3, 0.0])
    np.testing.assert_array_equal(space.upper, [np.inf, 180.0])


def test_index_finds_by_name_and_names_the_known_ones():
    space = ParameterSpace([WIDTH, ANGLE])
    assert [space.index(name) for name in space.names] == [0, 1]
    with pytest.raises(SettingError, match=r"no parameter is called 'leaf_with'; there are leaf_width, leaf_angle"):
        space.index("leaf_with")


def test_a_parameter_without_bounds_is_unbounded():
    free = Parameter("leaf_rotate_angle", "deg", mean=-3.5, std=2.0)
    assert (free.lower, free.upper) == (-np.inf, np.inf)


def test_the_mean_may_sit_on_a_bound():
    assert Parameter("a", "cm", mean=1.0, std=1.0, lower=1.0, upper=2.0).lower == 1.0
    assert Parameter("a", "cm", mean=2.0, std=1.0, lower=1.0, upper=2.0).upper == 2.0


@pytest.mark.parametrize(
    ("mean", "std"), [(np.nan, 1.0), (np.inf, 1.0), (1.0, 0.0), (1.0, -2.0), (1.0, np.nan), (1.0, np.inf)]
)
def test_mean_and_std_must_be_finite_and_std_positive(mean, std):
    with pytest.raises(SettingError, match=r"parameter leaf_width: expected a finite mean and a positive std, got"):
        Parameter("leaf_width", "cm", mean=mean, std=std)


@pytest.mark.parametrize(
    ("lower", "upper"), [(2.0, 3.0), (-3.0, 0.5), (1.0, 1.0), (np.nan, 2.0), (0.0, np.nan), (3.0, -3.0)]
)
def test_bounds_must_hold_the_mean_and_an_interval(lower, upper):
    with pytest.raises(SettingError, match=r"parameter leaf_width: expected lower <= mean <= upper and lower < upper"):
        Parameter("leaf_width", "cm", mean=1.0, std=1.0, lower=lower, upper=upper)


@pytest.mark.parametrize("parameters", [[], [WIDTH, ANGLE, WIDTH]])
def test_a_space_has_one_or_more_parameters_of_different_names(parameters):
    with pytest.raises(SettingError, match=r"expected one or more parameters of different names, got \["):
        ParameterSpace(parameters)


def test_a_space_is_a_value():
    space = ParameterSpace([WIDTH, ANGLE])
    assert space == ParameterSpace((WIDTH, ANGLE))
    assert space != ParameterSpace((ANGLE, WIDTH))
    assert pickle.loads(pickle.dumps(space)) == space
    with pytest.raises(dataclasses.FrozenInstanceError):
        space.parameters = ()
    space.mean[0] = 99.0  # a fresh array every time: nothing written to it comes back
    assert space.mean[0] == 6.0


def test_a_discrepancy_is_a_share_of_lengths_and_absolute_of_the_rest():
    space = ParameterSpace(
        [
            Parameter("length", "cm", 50.0, 10.0, discrepancy=0.02),
            Parameter("angle", "deg", 0.0, 10.0, discrepancy=3.0),
            Parameter("other", "cm", 5.0, 1.0),
        ]
    )
    np.testing.assert_allclose(space.discrepancy_at(np.array([-40.0, 25.0, 4.0])), [0.8, 3.0, 0.0])


@pytest.mark.parametrize("discrepancy", [-0.1, np.inf, np.nan])
def test_a_discrepancy_is_a_standard_deviation(discrepancy):
    with pytest.raises(SettingError, match="discrepancy"):
        Parameter("length", "cm", 50.0, 10.0, discrepancy=discrepancy)
