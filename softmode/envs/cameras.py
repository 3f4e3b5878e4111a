"""The cameras of the table: in front of it, over all of it, and on the hand."""

from softmode.splats.pinhole import PinholeCamera

Point = tuple[float, float, float]


def square_camera(name: str, edge: int, position: Point, target: Point, fov_y: float) -> PinholeCamera:
    """Return a camera with square pictures.

    Args:
        name: Name of the camera.
        edge: Edge of a picture [px].
        position: Where it stands [m].
        target: Where it looks [m].
        fov_y: Opening angle [rad].
    """
    return PinholeCamera.look_at(name, position=position, target=target, width=edge, height=edge, fov_y=fov_y)


def overview(name: str, edge: int) -> PinholeCamera:
    """Return the camera that sees arm and table, with pictures of `edge` x `edge` pixels."""
    return square_camera(name, edge, (1.05, -0.85, 0.60), (0.30, 0.0, 0.25), 0.60)


def wrist_camera(name: str, edge: int) -> PinholeCamera:
    """Return the camera on the hand that looks between the fingers, with pictures of `edge` x `edge` pixels."""
    return PinholeCamera.look_at(
        name,
        position=(0.12, 0.0, 0.02),
        target=(0.0, 0.0, 0.14),
        up=(-1.0, 0.0, 0.0),
        width=edge,
        height=edge,
        fov_y=1.1,
        body="link7",
    )
