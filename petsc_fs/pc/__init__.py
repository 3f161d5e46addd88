"""Preconditioners that PETSc lacks, for `-pc_type python -pc_python_type petsc_fs.pc.NAME`."""

from petsc_fs.pc.assembled import Assembled
from petsc_fs.pc.component_sweep import ComponentSweep
from petsc_fs.pc.contact_transform import ContactTransform
from petsc_fs.pc.fixed_stress import FixedStress
from petsc_fs.pc.joined import Joined

__all__ = ["Assembled", "ComponentSweep", "ContactTransform", "FixedStress", "Joined"]
