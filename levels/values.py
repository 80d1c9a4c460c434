"""Kinds of numbers that files hold, checked, and how what is wrong with them is said."""

from __future__ import annotations

import difflib
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    model_validator,
)
from pydantic_core import PydanticCustomError


def invalid(message: str, key: str | int | None = None) -> PydanticCustomError:
    """Validation error about ``key`` of the model at hand (or about all of it)."""
    # The text goes in as a value: pydantic would take braces in it for placeholders.
    return PydanticCustomError("level", "{text}", {"text": message, "key": key})


def unknown_key(key: str, allowed: list[str]) -> str:
    """Say that a field does not exist, with the closest one that does."""
    close = difflib.get_close_matches(key, allowed, n=1)
    hint = f", did you mean '{close[0]}'?" if close else ""
    return f"unknown field{hint} (allowed: {', '.join(allowed)})"


def _ordered(value: tuple[float, ...]) -> tuple[float, ...]:
    if value[0] > value[1]:
        raise invalid(f"expected [low, high] with low <= high, found [{value[0]}, {value[1]}]")
    return value


def repeated(count: int) -> BeforeValidator:
    def expand(value: Any) -> Any:
        plain_number = isinstance(value, int | float) and not isinstance(value, bool)
        return (value,) * count if plain_number else value

    return BeforeValidator(expand)


Number = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Length = Annotated[Number, Field(ge=-100.0, le=100.0)]
Angle = Annotated[Number, Field(ge=-6.2832, le=6.2832)]
Speed = Annotated[Number, Field(ge=-50.0, le=50.0)]
Force = Annotated[Number, Field(ge=-10.0, le=10.0)]
Triple = Field(min_length=3, max_length=3)
Position = Annotated[tuple[Length, ...], Triple]
Range = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class Model(BaseModel):
    # Validators are built when a level is first loaded, not when the package is imported.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _only_known_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise invalid(unknown_key(str(key), list(cls.model_fields)), str(key))
        return data
