"""Libraries that no package index has, or whose licence keeps them out: imported from a folder of the environment."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType

import pytest


def from_folder(name: str, variable: str) -> ModuleType:
    """The module, imported from the folders that the variable names; skips the test with the reason otherwise."""
    folders = list(filter(None, os.environ.get(variable, "").split(os.pathsep)))
    if not folders:
        pytest.skip(f"{variable} names no folder with {name}")
    sys.path += folders
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{name} in {folders[0]} cannot be imported: {error}")
    finally:
        del sys.path[-len(folders) :]
