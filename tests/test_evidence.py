"""Evidence, against the integral that it approximates."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats

from phytofit.engine.evidence import log_evidence

LAPLACE = 0.03  # nats; the posterior is a normal distribution cut off at its bounds


@pytest.mark.parametrize("inflation", [1.0, 4.0])
@pytest.mark.parametrize(("lower", "upper"), [(-50.0, 50.0), (0.9, 9.0), (-9.0, 1.3), (1.05, 30.0)])
def test_evidence_is_the_integral_over_what_lies_within_the_bounds(lower, upper, inflation):
    """Of numbers of a normal distribution, whose mean is not known; every one counts as a fourth, or whole."""
    values = 1.0 + np.array(
        [-1.0, 1.0] * 8 * int(inflation)
    )  # of variance 1: the scores' outer product is the curvature
    mean, std = min(2.0, upper), 3.0
    prior = stats.truncnorm((lower - mean) / std, (upper - mean) / std, mean, std)

    def density(x):
        return float(np.exp(np.sum(stats.norm.logpdf(values, x)) / inflation + 30.0) * prior.pdf(x))

    integral = integrate.quad(density, max(lower, -3.0), min(upper, 5.0), epsabs=0.0)[0]
    best = float(np.clip((values.sum() / inflation + mean / 9.0) / (len(values) / inflation + 1.0 / 9.0), lower, upper))
    posterior = SimpleNamespace(
        weights=None,
        prior=SimpleNamespace(
            free=np.array([True]),
            mean=np.array([mean]),
            precision=np.array([std**-2.0]),
            lower=np.array([lower]),
            upper=np.array([upper]),
        ),
    )
    at = SimpleNamespace(log_p=stats.norm.logpdf(values, best), scores=(values - best)[:, np.newaxis])
    state = SimpleNamespace(theta=np.array([best]))
    assert log_evidence(posterior, state, at, inflation) == pytest.approx(np.log(integral) - 30.0, abs=LAPLACE)
