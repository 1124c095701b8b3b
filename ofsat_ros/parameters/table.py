# Copyright 2026 ofsat_ros maintainers; SPDX-License-Identifier: Apache-2.0
"""What a parameter is: a field of a frozen dataclass with default, range, unit and meaning.

The machinery under the tables of this package: whoever adds a parameter adds a field to a table
and needs nothing of what is here but `number`, `choice` and `plain`.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, ClassVar, Self


class ParameterError(ValueError):
    """A parameter's name is unknown, or its value is of the wrong type or out of range."""


@dataclass(frozen=True)
class Description:
    """What the table says about one parameter.

    Attributes
    ----------
    name : str
        Name, the same in ROS, in YAML and on the command line.
    default : bool, int, float or str
        Value when nobody sets it; its type is the parameter's type.
    meaning : str
        One sentence for a user.
    stage : str
        The stage, or node, that reads it.
    unit : str
        Unit, empty for a pure number, a choice or a switch.
    low, high : float or None
        Inclusive range of a number.
    choices : tuple of str
        Allowed values of a choice; empty for the others.
    live : bool
        Whether a running node accepts a new value.
    """

    name: str
    default: Any
    meaning: str
    stage: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = True

    @property
    def allowed(self) -> str:
        """The allowed values in words, for messages and tables."""
        if self.choices:
            return " | ".join(self.choices)
        if isinstance(self.default, bool):
            return "true | false"
        if self.low is not None:
            return f"{self.low:.10g} to {self.high:.10g}"
        return "text"

    def check(self, value: Any) -> Any:
        """Return `value` in the parameter's type.

        Raises
        ------
        ParameterError
            If the value has another type or lies outside the range; the message names the
            parameter, the value and what is allowed.
        """
        kind = type(self.default)
        numeric = isinstance(value, Real) and not isinstance(value, bool)
        if numeric and self.low is not None and self.high is not None:
            if not self.low <= value <= self.high:  # NaN is in no range
                unit = f" {self.unit}" if self.unit else ""
                raise ParameterError(
                    f"{self.name} must be within {self.allowed}{unit}, not {value!r}"
                )
            value = kind(value) if kind(value) == value else value
        if type(value) is not kind:
            words = {bool: "a switch", int: "an integer", float: "a number", str: "text"}
            raise ParameterError(
                f"{self.name} must be {words[kind]} ({self.allowed}), not {value!r}"
            )
        if self.choices and value not in self.choices:
            raise ParameterError(f"{self.name} must be one of {self.allowed}, not {value!r}")
        return value


def number(
    default: float, low: float, high: float, unit: str, stage: str, meaning: str, live: bool = True
) -> Any:
    """A number, integer if its default is one, within a range."""
    about = {"unit": unit, "low": low, "high": high}
    return field(default=default, metadata=dict(stage=stage, meaning=meaning, live=live, **about))


def choice(choices: str, stage: str, meaning: str, live: bool = True) -> Any:
    """A choice among words separated by spaces; the first is the default."""
    words = tuple(choices.split())
    about = {"choices": words}
    return field(default=words[0], metadata=dict(stage=stage, meaning=meaning, live=live, **about))


def plain(default: bool | str, stage: str, meaning: str, live: bool = True) -> Any:
    """A switch or a text."""
    return field(default=default, metadata=dict(stage=stage, meaning=meaning, live=live))


@dataclass(frozen=True)
class Table:
    """Base of the parameter classes: checks every value when built."""

    names: ClassVar[str] = "parameter"

    def __post_init__(self) -> None:
        for about in self.describe():
            object.__setattr__(self, about.name, about.check(getattr(self, about.name)))

    @classmethod
    def describe(cls) -> Iterator[Description]:
        """Yield the description of every parameter, in the order of the table."""
        for item in dataclasses.fields(cls):
            yield Description(name=item.name, default=item.default, **item.metadata)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Build from a mapping of names to values; what is absent keeps its default.

        Raises
        ------
        ParameterError
            On an unknown name (the message suggests a similar one) or a bad value.
        """
        return cls().replace(**values)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed.

        Raises
        ------
        ParameterError
            As in `of`.
        """
        known = [item.name for item in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]}?" if near else ""
                raise ParameterError(f"there is no parameter {name!r}{hint}")
        return dataclasses.replace(self, **changes)

    def as_dict(self) -> dict[str, Any]:
        """Return names and values, in the order of the table."""
        return dataclasses.asdict(self)
