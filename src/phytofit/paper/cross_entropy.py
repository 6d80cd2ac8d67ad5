"""The cross-entropy method for continuous optimisation: section IV-D, Algorithm 1."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phytofit.errors import SettingError
from phytofit.parameters import ParameterSpace

__all__ = ["CrossEntropy", "Generation"]

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Generation:
    """What one generation of the search left: the elite's mean (k,) and covariance (k, k), before noise is added.

    ``threshold`` is the error of the worst elite candidate (the paper's level gamma, with the sign turned);
    ``best_x`` (k,) and ``best_error`` are the generation's best candidate.
    """

    index: int
    mean: FloatArray
    cov: FloatArray
    threshold: float
    best_x: FloatArray
    best_error: float


class CrossEntropy:
    """Search by sampling: draw candidates from a normal distribution, refit it to the best of them, repeat.

    >>> search = CrossEntropy(space, seed=0)
    >>> while not search.done:
    ...     xs = search.ask()                 # (n_samples, k)
    ...     search.tell(xs, objective(xs))    # errors (n_samples,), minimised
    >>> search.mean

    The distribution is multivariate normal with full covariance, Eq. (6) and (7).  The elite are the best
    ``elite_fraction`` of a generation: the paper's text keeps the top (1 - rho), rho = 0.9; line 1 of its Algorithm 1
    reads N^e = ceil(rho N), which would keep nine tenths and does not agree with line 3.

    After generation t the diagonal covariance noise Z_t = Z_0 (1 - t / t_max) is added,
    Z_0 = ``covariance_noise`` diag(Sigma_0).

    Bounds of the space are respected by drawing anew; what still falls outside after many draws is mirrored at the
    bound, so that samples never pile up on it.  An error of ``inf`` (or NaN) says that a candidate is not elite.
    """

    MAX_REDRAWS = 100

    def __init__(
        self,
        space: ParameterSpace,
        *,
        n_samples: int = 500,
        n_generations: int = 10,
        elite_fraction: float = 0.1,
        covariance_noise: float = 0.5,
        mean: ArrayLike | None = None,
        seed: int = 0,
    ) -> None:
        """Start from the space's prior, or from another `mean` (k,)."""
        if n_generations < 1:
            raise SettingError(f"generations: expected 1 or more, got {n_generations}")
        if not 0 < elite_fraction < 1:
            raise SettingError(f"elite_fraction: expected a number between 0 and 1, got {elite_fraction:g}")
        if not (np.isfinite(covariance_noise) and covariance_noise >= 0):
            raise SettingError(f"covariance_noise: expected 0 or more, got {covariance_noise:g}")
        self.n_elite = int(np.ceil(round(elite_fraction * n_samples, 9)))  # 0.07 * 100 is 7, not a little more
        if self.n_elite < 2:
            raise SettingError(
                f"samples: expected {int(round(1 / elite_fraction, 9)) + 1} or more, of which two are the elite "
                f"(elite_fraction {elite_fraction:g}), got {n_samples}"
            )
        self.space = space
        self.n_samples = n_samples
        self.n_generations = n_generations
        self.mean: FloatArray = np.array(space.mean if mean is None else mean, float)
        if self.mean.shape != (len(space),):
            raise SettingError(f"mean: expected {len(space)} numbers, got shape {self.mean.shape}")
        if not np.all((self.mean >= space.lower) & (self.mean <= space.upper)):  # false for NaN too
            raise SettingError(f"mean: expected numbers within the bounds of the space, got {self.mean.tolist()}")
        self.cov: FloatArray = np.diag(space.std**2)
        self.history: list[Generation] = []
        self._noise = covariance_noise * space.std**2  # diagonal of Z_0
        self._random = np.random.default_rng(seed)

    @property
    def done(self) -> bool:
        return len(self.history) >= self.n_generations

    def ask(self) -> FloatArray:
        """Draw the next generation, (n_samples, k), Algorithm 1, step 3."""
        lower, upper = self.space.lower, self.space.upper
        # symmetric root by eigenvectors: defined where the covariance is singular, as for a very small elite
        values, vectors = np.linalg.eigh(self.cov)
        root = vectors * np.sqrt(np.maximum(values, 0.0))

        def draw(n: int) -> FloatArray:
            xs: FloatArray = self.mean + self._random.standard_normal((n, len(self.space))) @ root.T
            return xs

        xs = draw(self.n_samples)
        for _ in range(self.MAX_REDRAWS):
            outside = np.any((xs < lower) | (xs > upper), axis=1)
            if not outside.any():
                return xs
            xs[outside] = draw(int(outside.sum()))
        return _mirror(xs, lower, upper)

    def tell(self, xs: FloatArray, errors: ArrayLike) -> Generation:
        """Take the errors (n_samples,) of the candidates xs and refit the distribution, Algorithm 1, steps 3 to 5."""
        errors = np.asarray(errors, float)
        if self.done:
            raise SettingError(f"tell: all {self.n_generations} generations have been told")
        if xs.shape != (self.n_samples, len(self.space)) or errors.shape != (self.n_samples,):
            raise SettingError(
                f"tell: expected xs ({self.n_samples}, {len(self.space)}) and errors ({self.n_samples},), "
                f"got {xs.shape} and {errors.shape}"
            )
        order = np.argsort(errors, kind="stable")[: self.n_elite]  # NaN sorts last
        if not np.isfinite(errors[order[-1]]):
            raise SettingError(f"tell: expected at least {self.n_elite} finite errors, got {np.isfinite(errors).sum()}")
        elite = xs[order]
        self.mean = elite.mean(axis=0)
        deviation = elite - self.mean
        cov = deviation.T @ deviation / self.n_elite  # the solution of Algorithm 1, step 4, Eq. (7)
        generation = Generation(
            len(self.history) + 1,
            self.mean,
            cov,
            float(errors[order[-1]]),
            elite[0].copy(),
            float(errors[order[0]]),
        )
        self.history.append(generation)
        t = len(self.history)
        self.cov = cov + np.diag(self._noise * (1.0 - t / self.n_generations))  # Sigma_t + Z_t
        return generation


def _mirror(xs: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Fold values outside [lower, upper] back inside, as often as needed."""
    both = np.isfinite(lower) & np.isfinite(upper)
    span = np.where(both, upper - lower, 1.0)
    low = np.where(np.isfinite(lower), lower, 0.0)
    folded = low + span - np.abs((xs - low) % (2 * span) - span)
    xs = np.where(both, folded, xs)
    xs = np.where(xs < lower, 2 * lower - xs, xs)
    return np.where(xs > upper, 2 * upper - xs, xs)
