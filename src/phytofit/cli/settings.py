"""Defaults and names as the help shows them, read from the text of the modules where they live.

A setting exists once, as the keyword default of the function that uses it; but importing those functions imports NumPy
and Numba, which takes seconds, and whoever asks for help should not wait.  So the sources are parsed, not imported.
"""

import ast
import pkgutil
from functools import cache
from typing import Any

__all__ = ["defaults_of", "entries_of", "value_of"]


def defaults_of(module: str, function: str) -> dict[str, Any]:
    """The keyword defaults of a function of ``phytofit.module`` that are plain values, as
    :func:`phytofit.recipe.defaults` gives them: no functions."""
    module, node = _find(module, function)
    assert isinstance(node, ast.FunctionDef)
    arguments = node.args
    positional = arguments.args[len(arguments.args) - len(arguments.defaults) :]
    given = [*zip(positional, arguments.defaults, strict=True)]
    given += [(name, value) for name, value in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True) if value]
    return {name.arg: _value(module, value) for name, value in given if not isinstance(value, ast.Lambda)}


def entries_of(module: str, name: str) -> dict[str, str]:
    """The keys of a dictionary that ``phytofit.module`` writes out, and the source of their values."""
    _, node = _find(module, name)
    assert isinstance(node, ast.Dict)
    return {ast.literal_eval(key): ast.unparse(value) for key, value in zip(node.keys, node.values, strict=True) if key}


def value_of(module: str, name: str) -> Any:
    """A plain value that bears this name in ``phytofit.module``."""
    return _value(module, ast.Name(name))


def _value(module: str, node: ast.expr) -> Any:
    """What the expression stands for: a literal, or the name of one."""
    if isinstance(node, ast.Name):
        where, found = _find(module, node.id)
        assert isinstance(found, ast.expr)
        return _value(where, found)
    return ast.literal_eval(node)


def _find(module: str, name: str) -> tuple[str, ast.AST]:
    """The function or the value that bears this name in the module, and the module in which it was made."""
    for node in _parsed(module).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return module, node
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == name for t in node.targets):
            return module, node.value
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id == name:
            assert node.value is not None
            return module, node.value
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("phytofit."):
            for alias in node.names:
                if name == (alias.asname or alias.name):
                    return _find(node.module.removeprefix("phytofit."), alias.name)
    raise AssertionError(f"phytofit.{module} has no {name}")


@cache
def _parsed(module: str) -> ast.Module:
    path = module.replace(".", "/")
    try:
        source = pkgutil.get_data("phytofit", f"{path}.py")
    except FileNotFoundError:
        source = pkgutil.get_data("phytofit", f"{path}/__init__.py")
    assert source is not None
    return ast.parse(source)
