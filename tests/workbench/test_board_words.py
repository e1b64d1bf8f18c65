"""Words of a header on its fields."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import xarray as xr

from robins.earth import Geodetic
from robins.export.field_notes import attitude_lines, components, field_notes, tangent_axes
from robins.filters import Belief, FilterState
from robins.ins.extended_pose import ExtendedPose
from robins.manifold import Angle
from robins.rotation import BodyRotation, Rotation
from robins.systems.study import Problem, SensorAxes, StateBlock


class Mean(NamedTuple):
    attitude: Rotation
    course: Angle
    place: Any  # three of position, one of clock


MEAN = Mean(Rotation.identity(), Angle(jnp.zeros(())), jnp.zeros(4))
PROBLEM = Problem(
    epoch_s=np.zeros(1),
    blocks=[
        StateBlock("turn", slice(0, 3), "rad", "deg", "NED", ("north", "east", "down")),
        StateBlock("course", slice(3, 4), "rad", "deg", "NED", ("yaw",)),
        StateBlock("position", slice(4, 7), "m", "m", "ENU", ("east", "north", "up")),
    ],
    sensors={"fix": SensorAxes("m", "ENU", ("east", "north", "up"))},
    simulate=lambda run: None,
    contenders={},
    claims=lambda metrics: [],
    context=xr.Dataset(),
)
# The place has north, east, down inside; attitude and course are reported as they are.
REPORTED = np.zeros((7, 8))
REPORTED[range(4), range(4)] = 1.0
REPORTED[4, 5] = REPORTED[5, 4] = 1.0
REPORTED[6, 6] = -1.0


def state_of(mean):
    belief = Belief(mean, np.zeros((0, 0)))
    return FilterState(belief, (FilterState(belief, ()),))


def test_the_mean_has_units_and_axes_in_its_own_order():
    axes = tangent_axes(PROBLEM, REPORTED, 8)
    notes = field_notes(
        PROBLEM, axes, state_of(MEAN), {"predict": (), "update_fix": (np.zeros(3), None)}
    )
    assert notes["state", "mean_attitude_wxyz"] == (
        "unit quaternion, scalar first; error: turn [rad], NED: north, east, down"
    )
    assert notes["state", "mean_course_rad"] == "course [rad], NED: yaw"
    assert notes["state", "mean_place"] == "0 to 2: position [m], ENU: north, east, minus up"
    assert notes["update_fix_reading", "value"] == "m, ENU: east, north, up"
    assert components(axes)[1:] == [
        "  0 to 2: turn [rad], NED: north, east, down",
        "  3: course [rad], NED: yaw",
        "  4 to 6: position [m], ENU: north, east, minus up",
        "  the others: what the model adds to them",
    ]


def test_a_quaternion_has_its_convention_and_the_side_of_its_error():
    turned, phi = Rotation.identity(), jnp.array([0.1, -0.2, 0.3])
    convention, side = attitude_lines(MEAN)
    assert "Hamilton, scalar first; q_nb maps coordinates in b (body)" in convention
    assert "true = exp(phi x) estimate" in side
    start = Rotation.from_rotvec(jnp.array([0.5, 0.5, 0.0]))
    after, turn = start.retract(phi).as_dcm(), Rotation.from_rotvec(phi).as_dcm()
    np.testing.assert_allclose(after, turn @ start.as_dcm(), atol=1e-14)
    assert "true = estimate exp(phi x)" in attitude_lines(BodyRotation(turned.wxyz))[1]
    body = BodyRotation(start.wxyz).retract(phi).as_dcm()
    np.testing.assert_allclose(body, start.as_dcm() @ turn, atol=1e-14)
    assert len(attitude_lines(ExtendedPose.identity("left"))) == 1  # its error is that of all
    assert attitude_lines({"rate": jnp.zeros(3)}) == []


def test_what_an_element_holds_is_in_its_own_units():
    class Track(NamedTuple):
        pose: ExtendedPose
        place: Geodetic

    mean = Track(ExtendedPose.identity(), Geodetic(0.5, 0.5, 0.5))
    axes = tangent_axes(PROBLEM, np.eye(7, 12), 12)
    notes = field_notes(
        PROBLEM, axes, state_of(mean), {"update_fix": (Geodetic(0.5, 0.5, 0.5), None)}
    )
    for struct, name in (("state", "mean_place"), ("update_fix_reading", "value")):
        where = {field: text for (one, field), text in notes.items() if one == struct}
        root = name.removesuffix("value") + ("_" if name != "value" else "")
        assert where[f"{root}lat"] == "rad, geodetic latitude, positive north"
        assert where[f"{root}lon"] == "rad, longitude, positive east"
        assert where[f"{root}alt"] == "m, height above the ellipsoid, positive up"
    assert notes["state", "mean_pose_velocity"] == "m/s"
    assert notes["state", "memory_0_belief_mean_place_lat"] == notes["state", "mean_place_lat"]
    assert notes["state", "mean_pose_rotation_wxyz"] == "unit quaternion, scalar first"


def test_what_is_reported_as_a_mixture_is_not_told():
    mixed = REPORTED.copy()
    mixed[4:7, 4:7] = np.full((3, 3), 0.5)
    axes = tangent_axes(PROBLEM, mixed, 8)
    assert axes[4:] == [None] * 4
    assert ("state", "mean_place") not in field_notes(PROBLEM, axes, state_of(MEAN), {})
    turning = np.stack([REPORTED, mixed])  # at two epochs
    assert tangent_axes(PROBLEM, turning, 8) == axes
    none = tangent_axes(PROBLEM, 0.5 * REPORTED, 8)
    assert components(none) == [
        "factor is lower triangular, covariance P = factor factor' of the error"
    ]
