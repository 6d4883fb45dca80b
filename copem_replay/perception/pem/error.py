"""Error models: the errors of listed objects. They scale the standard normals they are handed and never draw."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from copem_replay.core.components import Component, Covariance, NotNegative, Pair, ask_component, wrong_answer_error
from copem_replay.core.errors import FAILURES
from copem_replay.core.tracks import Float
from copem_replay.core.view_geometry import Errors, Noise, ViewGeometry


class ErrorModel(Component, ABC):
    """Base of error models.

    >>> class Widening(cr.ErrorModel):
    ...     def perturb(self, view, noise):
    ...         sigma_m = 0.01 * view.range_m
    ...         east_m, north_m = sigma_m * noise("east"), sigma_m * noise("north")
    ...         return cr.Errors(east_m, north_m, sigma_m**2, 0 * sigma_m, sigma_m**2)
    >>> view = cr.ViewGeometry(*np.full((10, 1), 20.0))
    >>> Widening(kind="my_package.models:Widening").perturb(view, lambda name: np.ones((4, 1))).cov_ee_m2.round(3)
    array([0.04])
    """

    @abstractmethod
    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        """Errors of every observation in every run, and the covariance that the unit states.

        `view` has P rows, one per object and list. `noise(name)` gives (S, P) standard normals, a row of them per run:
        one name for each independent quantity, the same numbers whenever it is asked for. No other source of chance.

        Returns `Errors`, all finite:

        - `east_m`, `north_m` (S, P): added to the true position, metres easting and northing.
        - `cov_ee_m2`, `cov_en_m2`, `cov_nn_m2` (P,): the covariance that the unit claims of these, m², in all runs.
          It is not checked against the errors: a model may claim more, or less, than is true.
        - `yaw_rad` (S, P) and `yaw_var_rad2` (P,): added to the true heading, counter-clockwise.
        - `size_m` (3, S, P) and `size_var_m2` (P,): added to length, width and height.
        - `speed_mps` (S, P) and `speed_var_m2ps2` (P,): added to the speed along the track.

        What is left out (None) is exact. Rows that no unit detects in a run are not used. Other types, shapes, NaN and
        infinity are errors that name the model.
        """


def ask_errors(model: ErrorModel, view: ViewGeometry, noise: Noise, runs: int, where: str) -> Errors:
    """The errors that a model gives, checked. Raises InputError that names `where` it stands."""
    errors = ask_component(model, where, lambda: model.perturb(view, noise))
    if not isinstance(errors, Errors):
        raise wrong_answer_error(
            model, where, f"perturb(view, noise): expected Errors, found {type(errors).__name__}", "perturb"
        )
    n = len(view.range_m)
    for field in fields(errors):
        values = getattr(errors, field.name)
        if values is None:
            continue
        variance = field.name.startswith("cov_") or "_var_" in field.name
        expected = (n,) if variance else (3, runs, n) if field.name == "size_m" else (runs, n)
        shape = np.shape(values)
        if shape != expected:
            raise wrong_answer_error(
                model, where, f"perturb: {field.name}: expected shape {expected}, found {shape}", "perturb"
            )
        if not np.isfinite(values).all():
            raise wrong_answer_error(
                model, where, f"perturb: {field.name}: expected numbers, found NaN or infinity", "perturb"
            )
    return errors


def find_noise_names(model: ErrorModel) -> frozenset[str] | None:
    """The names of the noise that a model requests, tried with no rows; None where the model fails at that."""
    names: set[str] = set()

    def noise(name: str) -> Float:
        names.add(name)
        return np.zeros((1, 0))

    try:
        model.perturb(ViewGeometry(*np.zeros((len(fields(ViewGeometry)), 0))), noise)
    except FAILURES:  # a user's own may not expect to be asked about none
        return None
    return frozenset(names)


class _Covariant(ErrorModel):
    """Position errors of a mean and a covariance, and spreads of yaw, size and speed; their shape is a subclass's."""

    covariance_m2: Covariance
    mean_m: Pair = (0.0, 0.0)
    frame: Literal["absolute", "line_of_sight"] = "absolute"
    yaw_sigma_deg: NotNegative = 0.0
    size_sigma_m: NotNegative = 0.0
    speed_sigma_mps: NotNegative = 0.0

    def draw_position(self, noise: Noise) -> tuple[Float, Float]:
        """(S, P) two uncorrelated numbers of mean 0 and variance 1."""
        return noise("position 1"), noise("position 2")

    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        """Offsets = mean + L·z with L·Lᵀ the covariance, turned into easting and northing."""
        (a, b), (_, d) = self.covariance_m2
        l11 = np.sqrt(a)
        # Rounding of a singular matrix must not be amplified: no row is longer than its variance says.
        l21 = float(np.clip(b / l11, -np.sqrt(d), np.sqrt(d))) if l11 > 0 else 0.0
        l22 = np.sqrt(max(d - l21 * l21, 0.0))
        z1, z2 = self.draw_position(noise)
        first = self.mean_m[0] + l11 * z1
        second = self.mean_m[1] + l21 * z1 + l22 * z2
        n = len(view.range_m)
        if self.frame == "absolute":
            east, north = first, second
            ee, en, nn = np.full(n, a), np.full(n, b), np.full(n, d)
        else:
            cos, sin = np.cos(view.bearing_rad), np.sin(view.bearing_rad)
            east, north = cos * first - sin * second, sin * first + cos * second
            ee = cos * cos * a - 2 * cos * sin * b + sin * sin * d
            en = cos * sin * (a - d) + (cos * cos - sin * sin) * b
            nn = sin * sin * a + 2 * cos * sin * b + cos * cos * d

        def spread(name: str, sigma: float) -> tuple[Float | None, Float | None]:
            return (sigma * noise(name), np.full(n, sigma**2)) if sigma > 0 else (None, None)

        yaw, yaw_var = spread("yaw", np.deg2rad(self.yaw_sigma_deg))
        speed, speed_var = spread("speed", self.speed_sigma_mps)
        size, size_var = None, None
        if self.size_sigma_m > 0:
            size = self.size_sigma_m * np.stack([noise("length"), noise("width"), noise("height")])
            size_var = np.full(n, self.size_sigma_m**2)
        return Errors(
            east, north, ee, en, nn,
            yaw_rad=yaw, yaw_var_rad2=yaw_var, size_m=size, size_var_m2=size_var,
            speed_mps=speed, speed_var_m2ps2=speed_var,
        )  # fmt: skip


class Gaussian(_Covariant):
    """Gaussian errors with full covariance.

    `frame: absolute` (the paper's): covariance and mean in easting and northing. `frame: line_of_sight`: along and
    across the line from the unit to the object (across: to its left), rotated to easting and northing.
    Optional standard deviations of yaw, of size (length, width and height independently) and of speed along the track.
    """

    kind: Literal["gaussian"] = "gaussian"


class StudentT(_Covariant):
    """As `gaussian`, of the same mean and covariance, but with heavier tails: position errors of Student's t.

    `degrees_of_freedom`: the fewer, the more errors are many times as large as usual; above 30 hardly any are. Both
    components of an error share a factor, √((ν − 2)/χ²), which is new in every list unless `memory` has `tails`.
    """

    kind: Literal["student_t"] = "student_t"
    degrees_of_freedom: Annotated[float, Field(strict=True, gt=2)]

    def draw_position(self, noise: Noise) -> tuple[Float, Float]:
        """(S, P) two numbers of mean 0 and variance 1, of a Student's t in two dimensions."""
        from scipy.special import chdtri, ndtr  # its import takes long

        nu = self.degrees_of_freedom
        factor = np.sqrt((nu - 2) / np.maximum(chdtri(nu, ndtr(-noise("tails"))), 1e-12))
        return factor * noise("position 1"), factor * noise("position 2")


ERROR_MODELS = {
    "gaussian": "copem_replay.perception.pem.error:Gaussian",
    "student_t": "copem_replay.perception.pem.error:StudentT",
}
"""Built-in names of `error: {kind: …}`."""
