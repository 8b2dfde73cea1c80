"""Least squares with prior sigmas, an estimated noise, and sigmas that count its degrees of freedom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats

NOISE_PASSES = 6


@dataclass(frozen=True)
class Adjusted:
    """Parameters (p,) with covariance (p, p); residuals (n,), their sigma, and its degrees of freedom.

    gain (p, n) : change of the parameters by that of the residuals

    The covariance is widened so that +- 1.96 sigma is the 95 % interval of Student's distribution.
    """

    parameters: Floats
    covariance: Floats
    residuals: Floats
    noise: float
    freedom: float
    gain: Floats

    def with_errors(self, derivatives: Floats, covariance: Floats) -> Adjusted:
        """The same with the errors of quantities (q,) that the residuals depend on: by their `derivatives` (n, q)."""
        change = self.gain @ derivatives
        return replace(self, covariance=self.covariance + change @ covariance @ change.T)

    @property
    def sigmas(self) -> Floats:
        """Of the parameters (p,)."""
        return np.sqrt(np.diag(self.covariance))


def adjust(
    residuals: Callable[[Floats], Floats], nominal: Floats, prior: Floats, least_noise: float, loss: str = "linear"
) -> Adjusted:
    """Parameters that minimise sum (r / noise)^2 + sum ((p - nominal) / prior)^2.

    prior (p,) : sigmas, inf for none; least_noise : of residuals, in their unit; loss : of scipy.optimize
    """
    from scipy import optimize

    tied = np.isfinite(prior)
    noise, p = max(float(np.std(residuals(nominal))), least_noise), nominal
    freedom, jacobian, left, count = 1.0, np.zeros((0, len(p))), np.zeros(0), 0
    for _ in range(NOISE_PASSES):
        scale = noise

        def both(x: Floats, scale: float = scale) -> Floats:
            return np.concatenate([residuals(x) / scale, ((x - nominal) / prior)[tied]])

        found = optimize.least_squares(both, p, method="trf" if loss != "linear" else "lm", loss=loss, x_scale=1.0)
        p, count = found.x, len(found.fun) - int(tied.sum())
        left, jacobian = residuals(p), found.jac
        hat = np.sum(np.linalg.solve(jacobian.T @ jacobian, jacobian[:count].T) * jacobian[:count].T)
        freedom = max(count - float(hat), 1.0)
        noise = max(float(np.sqrt(np.sum(left**2) / freedom)), least_noise)
        if abs(noise / scale - 1) < 1e-3:
            break
    wider = float(chi_square.student_ratio(freedom))
    inverse = np.asarray(np.linalg.inv(jacobian.T @ jacobian))
    return Adjusted(p, inverse * wider**2, left, noise, freedom, -inverse @ jacobian[:count].T / noise)


def derivatives_of(function: Callable[[Floats], Floats], at: Floats, steps: Floats) -> Floats:
    """Derivatives (n, q) of a function of (q,) by central differences of `steps` (q,)."""
    sides = [(function(at + step) - function(at - step)) for step in np.diag(steps)]
    return np.stack(sides, axis=1) / (2 * steps)
