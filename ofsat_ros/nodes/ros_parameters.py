# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""ROS parameters from the package's one table: declared, described, checked, changed live.

Stands between ``parameters`` (what exists and what is allowed) and a node's parameter services.
A name that no table knows is refused, at the start and while running.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter

from ofsat_ros.parameters import TABLES, Description, ParameterError, Table

_T = TypeVar("_T", bound=Table)


def start_value(node: Node, name: str, default: Any) -> Any:
    """Return what the command line or a YAML file says for a parameter, else `default`."""
    override = _overrides(node).get(name)
    return default if override is None else override.value


class NodeParameters:
    """The parameters of one node.

    Parameters
    ----------
    node : Node
        Declares them.
    *tables : Table
        One instance per class of parameters; it gives the values of what nobody sets at start.
    changed : callable, optional
        Called with the new table after a change; all parameters set in one call change at once.

    Raises
    ------
    ParameterError
        If a start value is bad.
    """

    def __init__(
        self, node: Node, *tables: Table, changed: Callable[[Table], None] | None = None
    ) -> None:
        self._tables: dict[type[Table], Table] = {}
        self._descriptions: dict[str, Description] = {}
        self._owner: dict[str, type[Table]] = {}
        self._changed = changed
        for table in tables:
            self._declare(node, table)
        node.add_pre_set_parameters_callback(self._convert)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def __getitem__(self, table: type[_T]) -> _T:
        """Return the current values of one class of parameters."""
        return self._tables[table]  # type: ignore[return-value]

    def _declare(self, node: Node, table: Table) -> None:
        abouts = {about.name: about for about in table.describe()}
        given = {
            name: _as_text(given, abouts[name]).value
            for name, given in _overrides(node).items()
            if name in abouts
        }
        table = table.replace(**given)
        self._tables[type(table)] = table
        for name, value in table.as_dict().items():
            self._descriptions[name] = abouts[name]
            self._owner[name] = type(table)
            node.declare_parameter(name, value, _descriptor(abouts[name]), ignore_override=True)

    def _convert(self, parameters: list[Parameter]) -> list[Parameter]:
        """Turn 2 into 2.0 or "2" where a number or a text is asked for; refuse unknown names."""
        converted = []
        for parameter in parameters:
            about = self._descriptions.get(parameter.name)
            if about is None and parameter.name not in _FOREIGN_NAMES:
                hint = _hint(parameter.name, self._descriptions)
                raise ParameterNotDeclaredException(f"{parameter.name}{hint}")
            if about is not None and isinstance(about.default, float):
                if parameter.type_ is Parameter.Type.INTEGER:
                    parameter = Parameter(parameter.name, value=float(parameter.value))
            if about is not None:
                parameter = _as_text(parameter, about)
            converted.append(parameter)
        return converted

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            self._replaced(parameters)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        for kind, table in self._replaced(parameters).items():
            self._tables[kind] = table
            if self._changed is not None:
                self._changed(table)

    def _replaced(self, parameters: list[Parameter]) -> dict[type[Table], Table]:
        changes: dict[type[Table], dict[str, Any]] = {}
        for parameter in parameters:
            if parameter.name in self._owner:
                own = changes.setdefault(self._owner[parameter.name], {})
                own[parameter.name] = parameter.value
        return {kind: self._tables[kind].replace(**values) for kind, values in changes.items()}


def _as_text(parameter: Parameter, about: Description) -> Parameter:
    """Turn 4171 into "4171" where a text is asked for: ROS reads numbers as such."""
    free = isinstance(about.default, str) and not about.choices
    if free and parameter.type_ is Parameter.Type.INTEGER:
        return Parameter(parameter.name, value=str(parameter.value))
    return parameter


def refuse_unknown(node: Node) -> None:
    """Raise if the command line or a YAML file sets a parameter that the node does not have.

    A parameter of another node of this package is only warned of: one YAML may serve them all.

    Raises
    ------
    ParameterError
        Naming the parameter and a similar one.
    """
    others = {about.name: about.stage for table in TABLES for about in table.describe()}
    declared = [name for name in node._parameters if name not in _FOREIGN_NAMES]
    for name in _overrides(node):
        if node.has_parameter(name):
            continue
        if name not in others:
            raise ParameterError(f"there is no parameter {name!r}{_hint(name, declared)}")
        node.get_logger().warning(
            f"parameter {name} is read by {others[name]}, not by this node: ignored"
        )


# rclpy declares these itself.
_FOREIGN_NAMES = ("use_sim_time", "start_type_description_service")


def _overrides(node: Node) -> dict[str, Parameter]:
    # rclpy has no public way to ask which overrides were given; declare_parameter reads it too.
    return node._parameter_overrides


def _hint(name: str, known: Any) -> str:
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _descriptor(about: Description) -> ParameterDescriptor:
    unit = f" [{about.unit}]" if about.unit else ""
    descriptor = ParameterDescriptor(
        description=about.meaning + unit,
        additional_constraints=about.allowed,
        read_only=not about.live,
        # The table checks types as well, and says more than rclpy does.
        dynamic_typing=True,
    )
    if about.low is not None and isinstance(about.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(about.low), to_value=float(about.high))
        ]
    elif about.low is not None:
        descriptor.integer_range = [
            IntegerRange(from_value=int(about.low), to_value=int(about.high))
        ]
    return descriptor
