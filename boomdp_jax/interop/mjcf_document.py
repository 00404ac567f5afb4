"""A compiled MuJoCo document seen as a planar world: names, frames, what is refused."""

import importlib
import os
import types
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float

_LEVEL = 1e-6
"""How far out of the plane a direction may point."""


def load_mujoco() -> types.ModuleType:
    """MuJoCo, at first use.

    Returns:
        The module.

    Raises:
        ImportError: it is not installed.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            "MuJoCo is not installed; pip install 'boomdp_jax[test]'"
        ) from error


class Document:
    """A model at its start, and the planar frames of its bodies.

    The start is the key frame `start`, or else MuJoCo's reference configuration.
    """

    def __init__(self, source: str | os.PathLike):
        self.mujoco = load_mujoco()
        is_text = isinstance(source, str) and source.lstrip().startswith("<")
        self.source = "document" if is_text else str(source)
        load = self.mujoco.MjModel.from_xml_path
        if is_text:
            load = self.mujoco.MjModel.from_xml_string
        try:
            self.model: Any = load(str(source))
        except ValueError as error:
            message = " ".join(str(error).split())
            raise ValueError(
                f"{self.source}: expected MJCF that MuJoCo reads, got: {message}"
            ) from error
        self.data: Any = self.mujoco.MjData(self.model)
        self._place()
        self.rest = np.array([self._heading(i) for i in range(self.model.nbody)])
        """Headings of bodies in the reference configuration [rad]."""
        key = self.mujoco.mj_name2id(
            self.model, self.mujoco.mjtObj.mjOBJ_KEY.value, "start"
        )
        if key >= 0:
            self.mujoco.mj_resetDataKeyframe(self.model, self.data, key)
        self._place()
        self.theta = np.zeros(self.model.nbody)
        """Headings at the start, with whole turns counted as the joints do [rad]."""
        self.planar: dict[int, tuple[str, Float[np.ndarray, "2"]]] = {}
        """Planar body of a body of MuJoCo, and the origin of its outline's frame in
        the frame of MuJoCo's body [m]; static ones without an outline are missing."""

    def _place(self) -> None:
        """Frames and velocities, without the dynamics, which may be singular yet."""
        for stage in ("kinematics", "comPos", "comVel"):
            getattr(self.mujoco, f"mj_{stage}")(self.model, self.data)

    def refuse(self, kind: str, index: int, expected: str, got: object) -> NoReturn:
        """Say which element is outside of what a planar scene can hold.

        Args:
            kind: sort of element, as MuJoCo's accessor is called.
            index: which one.
            expected: what should stand there.
            got: what stands there.

        Raises:
            ValueError: always.
        """
        name = self.name(kind, index)
        raise ValueError(
            f"{self.source}: {kind} {name!r}: expected {expected}, got {got}"
        )

    def name(self, kind: str, index: int) -> str:
        """Name of an element, or its kind and number.

        Args:
            kind: as MuJoCo's accessor is called.
            index: which one.

        Returns:
            The name.
        """
        return getattr(self.model, kind)(index).name or f"{kind}{index}"

    def _heading(self, body: int) -> float:
        matrix = self.data.xmat[body]
        return float(np.arctan2(matrix[3], matrix[0]))

    def check_level(self, kind: str, index: int, matrix: np.ndarray) -> float:
        """Angle of a frame, which must be turned about z alone.

        Args:
            kind: of the element, for messages.
            index: which one.
            matrix: its nine numbers in the world frame.

        Returns:
            The angle [rad].
        """
        if np.abs(matrix[8] - 1.0) > _LEVEL:
            axis = np.round(matrix[[2, 5, 8]], 6).tolist()
            self.refuse(kind, index, "a frame whose z axis is the world's", axis)
        return float(np.arctan2(matrix[3], matrix[0]))

    def is_off(self, flag: str) -> bool:
        """Whether the document disables something.

        Args:
            flag: as the element `flag` calls it.
        """
        bits = self.mujoco.mjtDisableBit.__members__
        names = [f"mjDSBL_{flag.upper()}"]
        if flag in ("equality", "frictionloss", "limit", "contact"):
            names.append("mjDSBL_CONSTRAINT")
        if flag in ("spring", "damper"):
            # Of versions that disable both together.
            names.append("mjDSBL_PASSIVE")
        mask = sum(int(bits[name].value) for name in names if name in bits)
        return bool(self.model.opt.disableflags & mask)

    def is_static(self, body: int) -> bool:
        """Whether a body has no joint between it and the world."""
        return bool(self.model.body_weldid[body] == 0)

    def local(self, body: int, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2"]:
        """A world point in the frame of a planar body's outline, or of the world.

        Args:
            body: of MuJoCo.
            point: at the start [m].

        Returns:
            In the plane [m].
        """
        if body not in self.planar:
            return point[:2]
        matrix = self.data.xmat[body].reshape(3, 3)
        inside = matrix.T @ (point - self.data.xpos[body])
        return inside[:2] - self.planar[body][1]

    def attached(
        self, body: int, inside: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "2"]:
        """The same of a point of MuJoCo's body, exactly.

        Args:
            body: of MuJoCo.
            inside: in its frame [m].

        Returns:
            In the plane [m].
        """
        if body in self.planar:
            return inside[:2] - self.planar[body][1]
        matrix = self.data.xmat[body].reshape(3, 3)
        return (self.data.xpos[body] + matrix @ inside)[:2]

    def partner(self, body: int) -> str:
        """Name by which a constraint calls a body.

        Args:
            body: of MuJoCo.

        Returns:
            Of its planar body, or world.
        """
        return self.planar[body][0] if body in self.planar else "world"

    def angle(self, body: int) -> float:
        """Heading of what `partner` names, at the start [rad]."""
        return float(self.theta[body]) if body in self.planar else 0.0

    def rest_angle(self, body: int) -> float:
        """The same in the reference configuration [rad]."""
        return float(self.rest[body]) if body in self.planar else 0.0

    def direction(self, kind: str, index: int, axis: Float[np.ndarray, "3"]) -> float:
        """Angle of a direction that must lie in the plane.

        Args:
            kind: of the element, for messages.
            index: which one.
            axis: in the world frame.

        Returns:
            The angle [rad].
        """
        if abs(axis[2]) > _LEVEL * np.linalg.norm(axis):
            self.refuse(
                kind, index, "an axis in the x-y plane", np.round(axis, 6).tolist()
            )
        return float(np.arctan2(axis[1], axis[0]))


def wrapped(angle: float) -> float:
    """An angle between -π and π.

    Args:
        angle: any [rad].

    Returns:
        The same direction.
    """
    return float(np.arctan2(np.sin(angle), np.cos(angle)))
