"""Closed-form solutions of consolidation and of a fracture that slides, in numbers without units.

`Consolidation` is Terzaghi's column, `Mandel` is Mandel's slab, `SlidingFracture` a straight fracture under
compression in an infinite plane. PorePy is not imported here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TERMS = 400
"""Terms kept of each series."""


@dataclass(frozen=True, kw_only=True)
class Medium:
    """A poroelastic medium in plane strain.

    Attributes:
        shear_modulus: G.
        lame_lambda: lambda.
        biot_coefficient: alpha.
        storage: S, change of fluid content by pressure at constant strain.
        mobility: permeability over viscosity.
    """

    shear_modulus: float = 1.0
    lame_lambda: float = 1.0
    biot_coefficient: float = 1.0
    storage: float = 0.0
    mobility: float = 1.0

    @property
    def oedometric_modulus(self) -> float:
        """M = lambda + 2 G: stress over strain in one direction, with none in the others."""
        return self.lame_lambda + 2 * self.shear_modulus

    @property
    def diffusivity(self) -> float:
        """Of pressure: c = mobility / (S + alpha^2 / M)."""
        return self.mobility / (self.storage + self.biot_coefficient**2 / self.oedometric_modulus)

    @property
    def poisson_ratio(self) -> float:
        """Drained: nu = lambda / (2 (lambda + G))."""
        return self.lame_lambda / (2 * (self.lame_lambda + self.shear_modulus))

    @property
    def undrained_poisson_ratio(self) -> float:
        """The same with lambda + alpha^2 / S; 1/2 without storage."""
        if self.storage == 0:
            return 0.5
        undrained = self.lame_lambda + self.biot_coefficient**2 / self.storage
        return undrained / (2 * (undrained + self.shear_modulus))


@dataclass(frozen=True, kw_only=True)
class Consolidation:
    """Terzaghi's column 0 < y < height: loaded and drained at the top from t = 0, held and tight at the bottom.

    K. Terzaghi, "Die Berechnung der Durchlässigkeitsziffer des Tones aus dem Verlauf der hydrodynamischen
    Spannungserscheinungen", Sitzungsber. Akad. Wiss. Wien 132 (1923); A. Verruijt, "Theory and Problems of
    Poroelasticity" (2013), section 2.2.
    """

    medium: Medium = Medium()
    load: float = 1.0
    height: float = 1.0

    @property
    def initial_pressure(self) -> float:
        """Just after loading: alpha load / (alpha^2 + S M)."""
        m = self.medium
        return self.load * m.biot_coefficient / (m.biot_coefficient**2 + m.storage * m.oedometric_modulus)

    def pressure(self, y: Floats, t: float) -> Floats:
        """p(y, t), shape of `y`."""
        if t == 0:
            return np.full_like(y, self.initial_pressure)
        k, decay = self._modes(t)
        return self.initial_pressure * _sum((2 / k) * np.sin(k) * decay, np.cos, k, y / self.height)

    def displacement(self, y: Floats, t: float) -> Floats:
        """Upward displacement, from M du/dy = alpha p - load with u = 0 at the bottom."""
        m = self.medium
        if t == 0:
            integral = self.initial_pressure * y
        else:
            k, decay = self._modes(t)
            series = _sum((2 / k**2) * np.sin(k) * decay, np.sin, k, y / self.height)
            integral = self.initial_pressure * self.height * series
        return np.asarray((m.biot_coefficient * integral - self.load * y) / m.oedometric_modulus)

    def _modes(self, t: float) -> tuple[Floats, Floats]:
        k = (np.arange(TERMS) + 0.5) * np.pi
        return k, np.exp(-(k**2) * self.medium.diffusivity * t / self.height**2)


@dataclass(frozen=True, kw_only=True)
class Mandel:
    """Mandel's slab |x| < width, pressed between rigid smooth plates at y = 0 and above, drained at its sides.

    Pressure first rises in the middle. J. Mandel, "Consolidation des sols", Géotechnique 3 (1953); displacements:
    Y. Abousleiman et al., "Mandel's problem revisited", Géotechnique 46 (1996), which has the roots a_n > 0 of
    tan a = (1 - nu) / (nu_u - nu) a.

    Attributes:
        medium: isotropic; S must be positive.
        force: F on half of the slab, per length out of plane.
        width: a, half of the slab.
    """

    medium: Medium = Medium(storage=0.5)
    force: float = 1.0
    width: float = 1.0

    @cached_property
    def roots(self) -> Floats:
        """(TERMS,) a_n, by bisection of sin a - m a cos a between n pi and (n + 1/2) pi."""
        m = (1 - self.medium.poisson_ratio) / (self.medium.undrained_poisson_ratio - self.medium.poisson_ratio)
        turn = np.arange(TERMS) * np.pi
        low, high = turn + 1e-9, turn + np.pi / 2
        sign = np.cos(turn)
        for _ in range(80):
            middle = (low + high) / 2
            below = sign * (np.sin(middle) - m * middle * np.cos(middle)) < 0
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray((low + high) / 2)

    @property
    def initial_pressure(self) -> float:
        """Just after loading: F B (1 + nu_u) / (3 a), with Skempton's B, for an undrained slab."""
        m = self.medium
        # B (1 + nu_u) / 3 = (nu_u - nu) / (alpha (1 - 2 nu)), after Rice and Cleary.
        nu, nu_u = m.poisson_ratio, m.undrained_poisson_ratio
        return self.force / self.width * (nu_u - nu) / (m.biot_coefficient * (1 - 2 * nu))

    def pressure(self, x: Floats, t: float) -> Floats:
        """p(x, t), shape of `x`."""
        if t == 0:
            return np.full_like(x, self.initial_pressure)
        a, weight = self._modes(t)
        series = _sum(weight * np.sin(a), np.cos, a, x / self.width) - np.sum(weight * np.sin(a) * np.cos(a))
        return np.asarray(2 * self.initial_pressure * series)

    def displacement_x(self, x: Floats, t: float) -> Floats:
        """Sideways displacement, shape of `x`."""
        G, a_ = self.medium.shear_modulus, self.width
        nu, nu_u = self.medium.poisson_ratio, self.medium.undrained_poisson_ratio
        if t == 0:
            return np.asarray(self.force * nu_u / (2 * G * a_) * x)
        a, weight = self._modes(t)
        squeeze = self.force * (nu / 2 - nu_u * np.sum(weight * np.sin(a) * np.cos(a))) / (G * a_)
        return np.asarray(squeeze * x + self.force / G * _sum(weight * np.cos(a), np.sin, a, x / a_))

    def displacement_y(self, y: Floats, t: float) -> Floats:
        """Displacement along the force, zero at y = 0; shape of `y`."""
        G = self.medium.shear_modulus
        nu, nu_u = self.medium.poisson_ratio, self.medium.undrained_poisson_ratio
        if t == 0:
            return np.asarray(-self.force * (1 - nu_u) / (2 * G * self.width) * y)
        a, weight = self._modes(t)
        series = np.sum(weight * np.sin(a) * np.cos(a))
        return np.asarray(self.force * (-(1 - nu) / 2 + (1 - nu_u) * series) / (G * self.width) * y)

    def _modes(self, t: float) -> tuple[Floats, Floats]:
        """Roots a, and exp(-a^2 c t / width^2) / (a - sin a cos a)."""
        a = self.roots
        decay = np.exp(-(a**2) * self.medium.diffusivity * t / self.width**2)
        return a, decay / (a - np.sin(a) * np.cos(a))


@dataclass(frozen=True, kw_only=True)
class SlidingFracture:
    """A closed straight fracture |s| < half_length, at an angle to x, in a plane that is pressed along y.

    Its walls stay together and slide against Coulomb friction, as tan(angle) exceeds the friction coefficient. The
    solution is uniform stress and that of a fracture under shear in mode II (H. M. Westergaard, "Bearing pressures
    and cracks", J. Appl. Mech. 6 (1939)), with the shear stress that friction leaves over.

    Attributes:
        medium: of which the elastic constants count; plane strain.
        compression: far away, along y.
        friction: Coulomb coefficient.
        angle: of the fracture against the x axis, in radians.
        half_length: a.
    """

    medium: Medium = Medium()
    compression: float = 1e-3
    friction: float = 0.3
    angle: float = np.pi / 6
    half_length: float = 0.5

    @property
    def driving_stress(self) -> float:
        """Shear stress beyond friction: compression (sin cos - F cos^2) of the angle."""
        sine, cosine = np.sin(self.angle), np.cos(self.angle)
        return float(self.compression * cosine * (sine - self.friction * cosine))

    def slip(self, s: Floats) -> Floats:
        """Size of the tangential jump at distance `s` from the middle: 2 (1 - nu) / G driving sqrt(a^2 - s^2)."""
        m = self.medium
        opened = np.sqrt(np.maximum(self.half_length**2 - s**2, 0))
        return np.asarray(2 * (1 - m.poisson_ratio) / m.shear_modulus * self.driving_stress * opened)

    def displacement(self, x: Floats, y: Floats) -> Floats:
        """(2, n) displacement at points relative to the middle of the fracture, none of them on the fracture itself."""
        G, nu = self.medium.shear_modulus, self.medium.poisson_ratio
        # Uniform stress (0, -compression) in plane strain.
        uniform = self.compression / (2 * G) * np.stack([nu * x, -(1 - nu) * y])
        sine, cosine = np.sin(self.angle), np.cos(self.angle)
        along, across = cosine * x + sine * y, cosine * y - sine * x
        z = along + 1j * across
        root = np.sqrt(z - self.half_length) * np.sqrt(z + self.half_length)  # cut along the fracture
        # Compression along y shears the fracture the way of sigma_xy < 0 in its own coordinates.
        Z = -self.driving_stress * (z / root - 1)
        integral = -self.driving_stress * (root - z)
        u_along = (2 * (1 - nu) * integral.imag + across * Z.real) / (2 * G)
        u_across = (-(1 - 2 * nu) * integral.real - across * Z.imag) / (2 * G)
        return np.asarray(uniform + np.stack([cosine * u_along - sine * u_across, sine * u_along + cosine * u_across]))


def _sum(weights: Floats, function: np.ufunc, k: Floats, x: Floats) -> Floats:
    """Sum over n of weights_n function(k_n x); terms that have decayed are left out."""
    kept = np.abs(weights) > 1e-18 * np.abs(weights).max()
    return np.asarray(function(np.multiply.outer(x, k[kept])) @ weights[kept])
