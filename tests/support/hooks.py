"""The modules of the build of the documentation; docs/hooks is no package."""

import importlib.util

from tests.support.paths import ROOT


def hook(name):
    spec = importlib.util.spec_from_file_location(f"hook_{name}", ROOT / f"docs/hooks/{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
