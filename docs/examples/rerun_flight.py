"""Show a saved flight in the Rerun viewer: 3D, the camera's image and plots on one timeline.

    pip install rerun-sdk
    quad-gym fly circle --output flight.npz
    python docs/examples/rerun_flight.py flight.npz             # opens the viewer
    python docs/examples/rerun_flight.py flight.npz flight.rrd  # writes a recording for it

`rerun_recording` makes the recording of a `quad_gym.Flight` in memory, too.

| entity | contents |
|---|---|
| `world/reference`, `world/gates`, `world/features` | the reference, the gates, the features |
| `world/walls`, `world/cylinders`, `world/geofence` | the obstacles and the geofence |
| `world/truth`, `world/estimate` | the vehicle at its true and at its estimated pose |
| `world/truth/camera/image` | the image plane: features as measured, and as predicted |
| `world/ellipsoid` | the filter's 3-sigma ellipsoid of the position, at its true size |
| `world/gnss`, `world/rays` | fixes as they arrive, features while the camera sees them |
| `world/trail` | past positions of truth and estimate |
| `plots` | errors, position errors with the filter's 3 sigma, NEES with its band, rotors, actions |

Times are seconds since the start of the episode, lengths meters, in east, north, up. Rerun stores
3D objects in single precision and plots in double precision.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from quad_gym import Flight
from quad_gym.analysis.metrics import STATE_DIMENSION, chi_square_band
from quad_gym.records import GateDecision, Shape
from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm

Floats = NDArray[np.float64]

TIMELINE = "flight"
SIGMAS = 3.0
TRAIL_SECONDS, FIX_SECONDS, AHEAD_SECONDS = 6.0, 1.5, 1.0
ROTOR_RADIUS, FRUSTUM_DEPTH = 0.13, 0.55  #: [m]

# colors by Okabe and Ito, which people with a color vision deficiency can distinguish, on the
# viewer's dark background
TRUTH, ESTIMATE, REFERENCE = (0, 114, 178), (213, 94, 0), (0, 158, 115)
FIX, RAY, NEUTRAL = (204, 121, 167), (86, 180, 233), (130, 130, 130)


def rerun_recording(flight: Flight) -> rr.RecordingStream:
    """Return the recording of a flight."""
    recording = rr.RecordingStream("quad_gym")
    log = _Log(flight, recording)
    log.scene()
    log.vehicles()
    log.reference()
    log.plots()
    if flight.estimated:
        log.estimate()
        log.fixes()
        if flight.scene.has_camera:
            log.camera()
    recording.send_blueprint(_blueprint(flight))
    return recording


class _Log:
    """Sender of the columns of a flight to a recording, entity by entity."""

    def __init__(self, flight: Flight, recording: rr.RecordingStream) -> None:
        self._flight, self._scene, self._recording = flight, flight.scene, recording

    def _static(self, entity: str, what: Any) -> None:
        self._recording.log(entity, what, static=True, strict=True)

    def _send(self, entity: str, columns: Any, chosen: NDArray[np.bool_] | None = None) -> None:
        times = self._flight["time"]
        index = rr.TimeColumn(TIMELINE, duration=times if chosen is None else times[chosen])
        self._recording.send_columns(entity, indexes=[index], columns=columns, strict=True)

    # ---- the world ----------------------------------------------------------------------------

    def scene(self) -> None:
        """Log the constant part of the scene."""
        scene = self._scene
        self._static("about", rr.TextDocument(self._about(), media_type=rr.MediaType.MARKDOWN))
        self._static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        if scene.reference_period and not len(scene.gates_I):
            path = scene.reference(np.linspace(0.0, scene.reference_period, 81 + scene.pieces))
            self._static("world/reference/path", rr.LineStrips3D([path], colors=[NEUTRAL]))
        if count := len(scene.gates_I):
            sizes, labels = np.full((count, 3), scene.gate_radius), _numbers(count, first=1)
            style = {"colors": [REFERENCE], "labels": labels}
            gates = rr.Ellipsoids3D(centers=scene.gates_I, half_sizes=sizes, **style)
            self._static("world/gates", gates)
        self._obstacles()
        if scene.has_camera:
            style = {"colors": [NEUTRAL], "labels": _numbers(len(scene.features_I), first=0)}
            self._static("world/features", rr.Points3D(scene.features_I, radii=0.04, **style))

    def _obstacles(self) -> None:
        """Log walls as boxes, cylinders as cylinders, and the geofence as edges."""
        scene = self._scene
        solid = {"colors": [NEUTRAL], "fill_mode": "solid"}
        is_wall = scene.obstacles[:, 0] == Shape.WALL
        walls, cylinders = scene.obstacles[is_wall], scene.obstacles[~is_wall]
        if len(walls):
            yaw = np.arctan2(walls[:, 8], walls[:, 7])
            zero = np.zeros_like(yaw)
            turns = np.stack([zero, zero, np.sin(yaw / 2.0), np.cos(yaw / 2.0)], axis=1)
            sizes = {"centers": walls[:, 1:4], "half_sizes": walls[:, 4:7], "quaternions": turns}
            self._static("world/walls", rr.Boxes3D(**sizes, **solid))
        if len(cylinders):
            sizes = {"lengths": 2.0 * cylinders[:, 6], "radii": cylinders[:, 4]}
            shapes = rr.Cylinders3D(centers=cylinders[:, 1:4], **sizes, **solid)
            self._static("world/cylinders", shapes)
        if len(scene.geofence_I):
            low, high = scene.geofence_I
            box = rr.Boxes3D(mins=[low], sizes=[high - low], colors=[NEUTRAL])
            self._static("world/geofence", box)

    def _about(self) -> str:
        scene = self._scene
        about = {"task": scene.task, "observation": scene.observation, **self._flight.about}
        rows = [f"| {name} | {json.dumps(value)} |" for name, value in about.items()]
        return "\n".join(["| | |", "|---|---|", *rows])

    def reference(self) -> None:
        """Log the present reference, and the reference over the next second."""
        flight, scene = self._flight, self._scene
        at = rr.Points3D.columns(positions=flight["reference_position"])
        self._static("world/reference/now", rr.Points3D.from_fields(radii=0.05, colors=[REFERENCE]))
        self._send("world/reference/now", at)
        if scene.reference_period and not len(scene.gates_I):
            ahead = flight["time"][:, np.newaxis] + np.linspace(0.0, AHEAD_SECONDS, 13)
            strips = scene.reference(ahead.ravel()).reshape(len(flight), -1, 3)
            style = rr.LineStrips3D.from_fields(radii=0.015, colors=[REFERENCE])
            self._static("world/reference/next_second", style)
            self._send("world/reference/next_second", rr.LineStrips3D.columns(strips=strips))

    # ---- the vehicle --------------------------------------------------------------------------

    def vehicles(self) -> None:
        """Log the vehicle at its true pose, with body axes."""
        self._body("world/truth", "position", "quaternion", TRUTH)
        axes = 0.42 * np.eye(3)
        arrows = rr.Arrows3D(vectors=axes, colors=[NEUTRAL], labels=list("xyz"))
        self._static("world/truth/axes", arrows)
        self._trail("truth", "position", TRUTH)

    def estimate(self) -> None:
        """Log the vehicle at its estimated pose, with the covariance of its position."""
        flight = self._flight
        self._body("world/estimate", "estimated_position", "estimated_quaternion", ESTIMATE)
        self._trail("estimate", "estimated_position", ESTIMATE)
        good = np.isfinite(flight["covariance"]).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(flight["covariance"][good, :3, :3])
        turns = vectors * np.sign(np.linalg.det(vectors))[:, np.newaxis, np.newaxis]
        # the columns are the axes in I, so this is the rotation from the axes to I
        quaternions = dcm_to_quaternion(np.swapaxes(turns, 1, 2))
        self._static("world/ellipsoid", rr.Ellipsoids3D.from_fields(colors=[ESTIMATE]))
        columns = rr.Ellipsoids3D.columns(
            centers=flight["estimated_position"][good],
            half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
            quaternions=_xyzw(quaternions),
        )
        self._send("world/ellipsoid", columns, good)

    def _body(self, entity: str, position: str, attitude: str, color: tuple[int, ...]) -> None:
        flight, hubs = self._flight, self._scene.rotor_positions_B
        good = np.isfinite(flight[position]).all(axis=1) & np.isfinite(flight[attitude]).all(axis=1)
        columns = rr.Transform3D.columns(
            translation=flight[position][good], quaternion=_xyzw(flight[attitude][good])
        )
        self._send(entity, columns, good)
        angle = np.linspace(0.0, 2.0 * np.pi, 25)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        arms = [np.stack([np.zeros(3), hub]) for hub in hubs]
        rings = [hub + ROTOR_RADIUS * ring for hub in hubs]
        self._static(f"{entity}/body", rr.LineStrips3D([*arms, *rings], radii=0.01, colors=[color]))

    def _trail(self, name: str, position: str, color: tuple[int, ...]) -> None:
        """Log one segment per row; the view shows the segments of the last seconds."""
        places = self._flight[position]
        good = np.isfinite(places).all(axis=1)
        pieces = np.stack([np.concatenate([places[:1], places[:-1]]), places], axis=1)
        good &= np.isfinite(pieces).all(axis=(1, 2))
        entity = f"world/trail/{name}"
        self._static(entity, rr.LineStrips3D.from_fields(radii=0.008, colors=[color]))
        self._send(entity, rr.LineStrips3D.columns(strips=pieces[good]), good)

    # ---- sensors ------------------------------------------------------------------------------

    def fixes(self) -> None:
        """Log GNSS fixes when they arrive; in gray if the filter's gate rejected them."""
        fixes = self._flight["gnss_position"]
        measured = np.isfinite(fixes).all(axis=1)
        if measured.any():
            refused = self._flight["gnss_decision"][measured, 0] == GateDecision.REJECTED
            colors = np.where(refused[:, np.newaxis], NEUTRAL, FIX).astype(np.uint8)
            self._static("world/gnss", rr.Points3D.from_fields(radii=0.025))
            points = rr.Points3D.columns(positions=fixes[measured], colors=colors)
            self._send("world/gnss", points, measured)

    def camera(self) -> None:
        """Log the image plane with measured and predicted features, and rays to the features."""
        flight, scene = self._flight, self._scene
        turn = _xyzw(dcm_to_quaternion(scene.R_CB))
        camera = "world/truth/camera"
        self._static(camera, rr.Transform3D(translation=scene.camera_B, quaternion=turn))
        pinhole = rr.Pinhole(
            resolution=2.0 * scene.half_image,
            focal_length=scene.focal_length,
            principal_point=scene.half_image,
            image_plane_distance=FRUSTUM_DEPTH,
            color=RAY,
        )
        self._static(f"{camera}/image", pinhole)
        size = float(scene.half_image[0]) / 60.0
        R_BI = quaternion_to_dcm(np.nan_to_num(flight["estimated_quaternion"], nan=1.0))
        predicted = scene.project_features(flight["estimated_position"], R_BI)
        inside = (np.abs(predicted) <= scene.half_image).all(axis=2)
        seen = np.isfinite(flight["pixels"]).all(axis=2)
        for name, pixels, shown, color, radius in (
            ("predicted", predicted, inside, ESTIMATE, 1.6 * size),
            ("measured", flight["pixels"], seen, TRUTH, size),
        ):
            entity = f"{camera}/image/{name}"
            self._static(entity, rr.Points2D.from_fields(radii=radius, colors=[color]))
            points = rr.Points2D.columns(positions=(pixels + scene.half_image)[shown])
            self._send(entity, points.partition(shown.sum(axis=1)))

        eyes = flight["position"] + np.einsum(
            "nij,i->nj", quaternion_to_dcm(flight["quaternion"]), scene.camera_B
        )
        row, feature = np.nonzero(seen)
        strips = np.stack([eyes[row], scene.features_I[feature]], axis=1)
        self._static("world/rays", rr.LineStrips3D.from_fields(radii=0.005, colors=[RAY]))
        if len(strips):
            rays = rr.LineStrips3D.columns(strips=strips)
            self._send("world/rays", rays.partition(seen.sum(axis=1)))

    # ---- plots --------------------------------------------------------------------------------

    def plots(self) -> None:
        """Log errors, the filter's consistency, rotors and actions over time."""
        flight = self._flight
        self._plot("errors/tracking", flight["position_error"], TRUTH, "tracking error [m]")
        if self._scene.observation != "truth":
            words = "estimation error [m]"
            self._plot("errors/estimation", flight["estimation_error"], ESTIMATE, words)
        if flight.estimated:
            low, high = chi_square_band(STATE_DIMENSION)
            self._plot("consistency/nees", flight["nees"], ESTIMATE, "NEES")
            for name, value in (("lower", low), ("upper", high)):
                band = np.full(len(flight), value)
                self._plot(f"consistency/{name}", band, NEUTRAL, "95 % band")
            errors = flight["estimated_position"] - flight["position"]
            sigmas = np.sqrt(np.diagonal(flight["covariance"], axis1=1, axis2=2)[:, :3])
            for k, axis in enumerate(("east", "north", "up")):
                at = f"position/{axis}"
                self._plot(f"{at}/error", errors[:, k], ESTIMATE, f"{axis} error [m]")
                for sign, name in ((1.0, "upper"), (-1.0, "lower")):
                    sigma = sign * SIGMAS * sigmas[:, k]
                    self._plot(f"{at}/{name}", sigma, NEUTRAL, "3 sigma of the filter")
        colors = (TRUTH, ESTIMATE, REFERENCE, FIX)
        for k, color in enumerate(colors):
            speed = flight["rotor_speeds"][:, k]
            self._plot(f"rotors/{k}", speed, color, f"rotor {k} [rad/s]")
            self._plot(f"actions/{k}", flight["action"][:, k], color, f"action {k}")

    def _plot(self, name: str, values: Floats, color: tuple[int, ...], words: str) -> None:
        entity = f"plots/{name}"
        self._static(entity, rr.SeriesLines(colors=[color], names=[words]))
        good = np.isfinite(values)
        if good.any():
            self._send(entity, rr.Scalars.columns(scalars=values[good]), good)


def _blueprint(flight: Flight) -> rrb.Blueprint:
    """Return the layout of the viewer: 3D on the left, camera and plots on the right."""

    def last(seconds: float) -> Any:
        start = rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds)
        end = rrb.TimeRangeBoundary.cursor_relative()
        return rrb.VisibleTimeRanges(rrb.VisibleTimeRange(TIMELINE, start=start, end=end))

    trails = ("world/trail/truth", "world/trail/estimate")
    world = rrb.Spatial3DView(
        origin="world",
        name="flight",
        overrides={trail: [last(TRAIL_SECONDS)] for trail in trails}
        | {"world/gnss": [last(FIX_SECONDS)]},
    )
    plots = [rrb.TimeSeriesView(origin="plots/errors", name="errors")]
    image = []
    if flight.estimated:
        plots.append(rrb.TimeSeriesView(origin="plots/consistency", name="consistency"))
        axes = [
            rrb.TimeSeriesView(origin=f"plots/position/{axis}", name=f"position error {axis}")
            for axis in ("east", "north", "up")
        ]
        plots.append(rrb.Tabs(*axes))
        if flight.scene.has_camera:
            image = [rrb.Spatial2DView(origin="world/truth/camera/image", name="camera")]
    plots.append(
        rrb.Tabs(
            rrb.TimeSeriesView(origin="plots/rotors", name="rotor speeds"),
            rrb.TimeSeriesView(origin="plots/actions", name="actions"),
            rrb.TextDocumentView(origin="about", name="about"),
        )
    )
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(*image, *plots), column_shares=[3, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
    )


def _numbers(count: int, first: int) -> list[str]:
    return [str(first + k) for k in range(count)]


def _xyzw(q: Floats) -> Floats:
    """Quaternions (..., 4) in Rerun's order, from (w, x, y, z)."""
    return np.roll(q, -1, axis=-1)


def main() -> None:
    """Open the viewer, or write the file that is given."""
    parser = argparse.ArgumentParser(description="Show a saved flight in the Rerun viewer.")
    parser.add_argument("flight", type=Path, help="the flight, a file .npz")
    parser.add_argument("output", type=Path, nargs="?", help="the recording to write, a file .rrd")
    args = parser.parse_args()
    recording = rerun_recording(Flight.load(args.flight))
    if args.output is None:
        recording.spawn()
    else:
        recording.save(args.output)
        recording.disconnect()  # which completes the file


if __name__ == "__main__":
    main()
