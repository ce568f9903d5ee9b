"""What an object holds on to, counted by walking its references: memory that has to stay bounded, without a byte."""

from __future__ import annotations

import gc
from collections import Counter
from types import BuiltinFunctionType, CodeType, FrameType, FunctionType, ModuleType
from typing import Any

_NO_STATE = (type, ModuleType, CodeType, BuiltinFunctionType)


def held(root: object) -> Counter[type]:
    """How many objects of each type can be reached from one, itself included; code and modules are no state."""
    found: Counter[type] = Counter()
    seen: set[int] = set()
    waiting: list[Any] = [root]
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, _NO_STATE) or (isinstance(one, dict) and "__builtins__" in one):
            continue
        seen.add(id(one))
        found[type(one)] += 1
        waiting += _referents(one)
    return found


def _referents(one: Any) -> list[Any]:
    if isinstance(one, FunctionType):  # not the globals of its module
        return [*(one.__closure__ or ()), one.__defaults__, one.__kwdefaults__]
    if isinstance(one, FrameType):
        return list(one.f_locals.values())
    return gc.get_referents(one)
