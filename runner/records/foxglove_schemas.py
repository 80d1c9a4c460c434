"""JSON schemas of the Foxglove messages that are written, by their documented fields."""

from __future__ import annotations

from typing import Any

NUMBERS = "crazyarena.Numbers"

_NUMBER: dict[str, Any] = {"type": "number"}
_INTEGER: dict[str, Any] = {"type": "integer"}
_TEXT: dict[str, Any] = {"type": "string"}
_FLAG: dict[str, Any] = {"type": "boolean"}


def _of(title: str, **fields: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": fields, "required": list(fields)}


def _list(item: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": item}


_TIME = _of(
    "time",
    sec={"type": "integer", "minimum": 0},
    nsec={"type": "integer", "minimum": 0, "maximum": 999_999_999},
)
_VECTOR = _of("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _of("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _of("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOR = _of("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_BODY = {"pose": _POSE, "size": _VECTOR, "color": _COLOR}
_ENTITY = _of(
    "foxglove.SceneEntity",
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_TIME,
    frame_locked=_FLAG,
    metadata=_list(_of("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    arrows=_list({"type": "object"}),
    cubes=_list(_of("foxglove.CubePrimitive", **_BODY)),
    spheres=_list(_of("foxglove.SpherePrimitive", **_BODY)),
    cylinders=_list(
        _of("foxglove.CylinderPrimitive", **_BODY, bottom_scale=_NUMBER, top_scale=_NUMBER)
    ),
    lines=_list(
        _of(
            "foxglove.LinePrimitive",
            type={"title": "foxglove.LineType", "enum": [0, 1, 2]},
            pose=_POSE,
            thickness=_NUMBER,
            scale_invariant=_FLAG,
            points=_list(_of("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)),
            color=_COLOR,
            colors=_list(_COLOR),
            indices=_list(_INTEGER),
        )
    ),
    triangles=_list({"type": "object"}),
    texts=_list({"type": "object"}),
    models=_list({"type": "object"}),
)
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.FrameTransform": _of(
        "foxglove.FrameTransform",
        timestamp=_TIME,
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_VECTOR,
        rotation=_QUATERNION,
    ),
    "foxglove.PoseInFrame": _of(
        "foxglove.PoseInFrame", timestamp=_TIME, frame_id=_TEXT, pose=_POSE
    ),
    "foxglove.SceneUpdate": _of(
        "foxglove.SceneUpdate",
        deletions=_list({"type": "object"}),
        entities=_list(_ENTITY),
    ),
    "foxglove.Log": _of(
        "foxglove.Log",
        timestamp=_TIME,
        level={"title": "foxglove.LogLevel", "enum": [0, 1, 2, 3, 4, 5]},
        message=_TEXT,
        name=_TEXT,
        file=_TEXT,
        line={"type": "integer", "minimum": 0},
    ),
    NUMBERS: {
        "title": NUMBERS,
        "type": "object",
        "properties": {"timestamp": _TIME, "speed": _NUMBER, "nearest": _NUMBER},
        "required": ["timestamp", "speed"],
    },
}
