# The names of MuJoCo 4 come from extension modules without type information. This stub tells
# pyright that they exist; submodules such as mujoco.mjx are read from the installed package.
from typing import Any

def __getattr__(name: str) -> Any: ...
