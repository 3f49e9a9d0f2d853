"""Families of vineyards on which accuracy is measured: of each as many surveys as there are seeds."""

from vinemap.simulate.families.table import FAMILIES, family

__all__ = ["FAMILIES", "family"]
