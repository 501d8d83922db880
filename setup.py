"""Packages and data; everything else stands in pyproject.toml."""

from setuptools import find_namespace_packages, find_packages, setup

# The top-level folder recipes/ goes into the wheel as flashdex/recipes.
groups = [f"flashdex.recipes.{name}" for name in find_namespace_packages("recipes")]

setup(
    packages=[
        *find_packages(include=["flashdex", "flashdex.*"]),
        "flashdex.recipes",
        *groups,
    ],
    package_dir={"flashdex.recipes": "recipes"},
    package_data={
        "": ["*.yaml"],
        "flashdex": ["hands/**/*.xml", "hands/**/*.json", "py.typed"],
        "flashdex.reports": ["templates/*"],
    },
)
