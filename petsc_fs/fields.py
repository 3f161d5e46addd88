"""The fields of contact poromechanics with heat and wells: the one table that names them.

A new field is one more row here, its mapping from the simulator, and a level in an options file. What has no row, such
as the fraction of a tracer, is a field as well: `other_NAME`, one unknown per place.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from petsc_fs.errors import UsageError


@dataclass(frozen=True)
class Field:
    """One unknown of the coupled system and the equation that belongs to it.

    Attributes:
        name: HDF5 group, name in the DM, option prefix and row of the report.
        index: number of the field in the paper, J_ij (Zabegaev et al., arXiv:2501.07441); beyond it they count on.
        vector: whether there is one unknown per coordinate direction and cell, or one per cell.
        unknown: what the columns are.
        equation: what the rows are.
        unit: SI unit of the unknown.
    """

    name: str
    index: int
    vector: bool
    unknown: str
    equation: str
    unit: str

    def block_size(self, dimension: int) -> int:
        """Unknowns per cell in a domain of this dimension."""
        return dimension if self.vector else 1


FIELDS = (
    Field("contact", 1, True, "contact traction per fracture cell", "contact conditions C_n, C_tau", "1"),
    Field("intf_force", 2, True, "interface displacement", "interface force balance", "m"),
    Field("momentum", 3, True, "displacement of the rock", "momentum balance", "m"),
    Field("intf_flow", 4, False, "interface Darcy flux", "interface Darcy law", "m^3/s"),
    Field("intf_fourier", 7, False, "interface Fourier flux", "interface Fourier law", "W"),
    Field("intf_enthalpy", 8, False, "interface enthalpy flux", "enthalpy that the fluid carries", "W"),
    Field("well_flow", 9, False, "flux between well and fracture", "Peaceman's well model", "m^3/s"),
    Field("well_enthalpy", 10, False, "enthalpy flux of a well", "enthalpy that the fluid carries", "W"),
    Field("mass", 5, False, "pressure in rock, fractures and intersections", "fluid mass balance", "Pa"),
    Field("energy", 6, False, "temperature in rock, fractures and intersections", "energy balance", "K"),
)
"""In the order of elimination; `in_order` puts others behind them."""
FIELD_NAMES = tuple(field.name for field in FIELDS)


class _Table(dict[str, Field]):
    """Fields by name; those of the pattern `OTHER` are made when asked for."""

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or bool(re.fullmatch(OTHER, str(name)))

    def __missing__(self, name: str) -> Field:
        if name not in self:
            raise KeyError(name)
        what = name.partition("_")[2]
        return Field(name, len(FIELDS) + 1, False, what, f"equation of {what}", "")


OTHER = r"other_\w+"
"""Names of fields that the table does not have."""
FIELD = _Table({field.name: field for field in FIELDS})

ALIASES: dict[str, str] = {}
"""Fields by other names that files have for them, see `learn_aliases`."""

MECHANICS = ("intf_force", "momentum")
"""Fields that one multigrid treats together, under the name "mechanics"."""
FLUXES = ("intf_flow", "intf_fourier", "intf_enthalpy", "well_flow", "well_enthalpy")
"""Fields of fluxes between subdomains, which are eliminated together, under the name "fluxes"."""
POTENTIALS = ("mass", "energy")
"""Pressure and temperature, under the name "potentials" where both are there."""
FLOW = (*FLUXES, *POTENTIALS)


def field_of(name: str) -> str:
    """The field that a file means by a name, see `ALIASES`; also of a name that no field has."""
    return ALIASES.get(name, name)


def learn_aliases(text: str) -> None:
    """Take names that files have for fields from words such as `u=momentum,p=mass`.

    Raises:
        UsageError: it cannot be read, or names no field.
    """
    for word in text.split(","):
        name, _, field = (part.strip() for part in word.partition("="))
        if not name or field not in FIELD:
            raise UsageError(
                f"--fields: cannot read {word!r}; expected NAME=FIELD, for example u=momentum,p=mass; fields are "
                f"{', '.join(FIELD_NAMES)}"
            )
        ALIASES[name] = field


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """The given field names in the order of the table, others behind them by name."""
    present = set(names)
    others = sorted(name for name in present if name in FIELD and name not in FIELD_NAMES)
    return (*(name for name in FIELD_NAMES if name in present), *others)
