"""Dense monocular SLAM on one page: track, close loops, move the map, map; adjust all, refine."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool

from geogs.config import Config
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.executors.in_order import Deferred, InOrder
from geogs.executors.live import Live, urgent_stream
from geogs.geometry.camera import Camera
from geogs.gpu.installation import require_device
from geogs.guard.entrance import Entrance, changes_system
from geogs.loop.closer import LoopCloser
from geogs.loop.global_bundle import global_bundle
from geogs.mapping.mapper import Mapper
from geogs.pose_estimate import PoseEstimate
from geogs.priors.monocular_prior import MonocularPrior
from geogs.scene_mask import SceneMask
from geogs.slam_input import input_frame, require_camera, require_mask
from geogs.slam_output import SlamOutput
from geogs.stopwatch import StageProgress, Stopwatch, unwatched
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.frame_uncertainty import frame_uncertainty
from geogs.tracking.segment_trackers import Segments
from geogs.tracking.tracker import Tracker, TrackResult
from geogs.types import FoundFrames, Frame, MetricScale
from geogs.world.grid import SampleGrid
from geogs.world.world import World, check_world


class Slam(SlamOutput):
    """Dense monocular SLAM: feed images, read poses at once, and trajectory, map and depth maps.

    Its state is ``world``; its stages, ``segments`` (tracking), ``loops`` and the mapper of its
    ``executor``, update the world. Poses are world to camera, in an arbitrary unit, or in metres
    where frames come with sensor depth.
    """

    @checks_arguments
    @on_one_torch_thread
    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        device: str | torch.device = "auto",
        prior: MonocularPrior | None = None,
        live: bool = False,
        mask: Bool[np.ndarray, "h w"] | None = None,
        black_is_masked: bool = False,
        defers_map: bool = False,
        world: World | None = None,
        focal_deviation: float = 0.0,
        pinhole: Camera | None = None,
    ) -> None:
        """Start a new system, or continue with the ``world`` of another.

        Args:
            camera: of all images, with its lens; they need not be undistorted.
            config: all settings; the defaults if none.
            device: auto (a GPU where there is one), cpu, cuda or cuda:1.
            prior: monocular prior, applied to every keyframe.
            live: return from :meth:`process` when the pose is known, and do the rest in threads;
                else results are the same each time on a CPU.
            mask: true where images may show the scene; nothing else is matched, searched or mapped,
                nor, with ``black_is_masked``, black pixels of an image.
            defers_map: make the map in :meth:`refine`, from all keyframes at their final poses,
                unless ``mapping.when`` rules it out.
            focal_deviation: relative standard deviation of a focal length that was not given, but
                estimated from the video or guessed; it is then estimated again from all matches at
                the end.
            pinhole: of the map and of depth maps, of the images' size; default: what of the
                images fits into a straight one.

        Raises:
            InputError: images of that size cannot be tracked, the lens folds them over, or the
                world belongs to another camera.
            DeviceError: there is no such device, or it cannot be used.
        """
        self.entrance = Entrance()
        require_camera(camera)
        require_mask(mask, camera)
        self.config = c = config or Config()
        maps_at_end = defers_map and not live and c.mapping.may_follow
        self.world = world or World(maps_at_end=maps_at_end)
        self.stopwatch = Stopwatch(self.world.times)
        where = str(require_device(device))
        scene_mask = SceneMask(mask, black_is_masked)
        stream = urgent_stream(where) if live else None
        with torch.cuda.stream(stream):
            grid = SampleGrid(camera, where)
            operator = build_operator(c.tracking, grid, mask, black_is_masked)
            keyframes = self.world.keyframes.attached(
                grid, operator.encode, c.resident_keyframes, focal_deviation, pinhole
            )
            check_world(self.world)
            self.segments = Segments(self.world.segments, keyframes, operator, c, prior, live)
            self.loops = LoopCloser(self.segments, c.loop, not live, mask, self.world.loops)
            self._new_mapper = partial(Mapper, config=c.mapping, seed=c.seed, sensor=c.sensor)
            mapper = self._new_mapper(keyframes, table=self.world.map)
            parts = self.segments, mapper, self.stopwatch, scene_mask
            if live:
                self.executor: InOrder = Live(*parts, self._new_mapper, stream)
            else:
                self.executor = (Deferred if self.world.maps_at_end else InOrder)(*parts)
        self.world.map = self.executor.mapper.table
        self.pose: PoseEstimate | None = None
        """Estimate after the last frame; None before the first."""

    @changes_system
    @on_one_torch_thread
    def process(
        self, image: Frame | np.ndarray | torch.Tensor, timestamp: float | None = None
    ) -> PoseEstimate:
        """Estimate the pose of the camera at the next image; make keyframes and map of it.

        Ctrl-C in a program without a handler of its own waits for the end of the image.

        Args:
            image: RGB, uint8, height x width x 3, of the camera's size and with its lens, as an
                array or a tensor; or a :class:`geogs.Frame`, which has its own timestamp.
            timestamp: seconds, later than that of the image before; without it images come 30
                times a second.

        Returns:
            The pose, world to camera (``T_cw``), float64, in map units; none while the camera is
            not tracked in the main map. ``state`` says why.

        Raises:
            InputError: the image or its time cannot be used, the stream has ended by
                :meth:`finish`, or another thread or process is at work in this system. Nothing
                has changed then.
        """
        world = self.world
        if world.is_ended:
            raise InputError("The stream has ended by finish(); save it, and load it to go on.")
        frame = input_frame(image, timestamp, self.camera, world.frames, world.timestamp)
        with self.entrance.image(), self.executor.frame():
            state = self.executor.track(frame, self.loops.recognise, self._advance)
            world.frames = world.frames + 1
            world.timestamp = frame.timestamp
            self.pose = self._estimate(state, frame.timestamp)
        return self.pose

    def _advance(self, tracked: TrackResult, is_last: bool = False) -> None:
        """Close loops after tracking, correct the map, map keyframes that became final."""
        with self.stopwatch("loops"):
            joined = self.loops.update(tracked, is_last)
        self._update_map()
        final = (*tracked.finalized, *joined)
        world = self.world
        world.unmapped.extend(final)
        lag = 0 if is_last else self.config.mapping.lag
        self.executor.map(world.unmapped, final, lag, tracked.active)
        every = self.config.loop.global_ba_every
        if every and not is_last and len(self.segments.keyframe_ids) - world.adjusted >= every:
            self.adjust()

    def _update_map(self) -> None:
        """Apply the corrections of the keyframes to the map."""
        for correction in self.segments.main.keyframes.take_corrections():
            with self.stopwatch("map update"):
                self.executor.mapping.correct(correction)

    @changes_system
    @on_one_torch_thread
    def end_stream(self) -> None:
        """Map the remaining keyframes after the last frame. This is the online result."""
        with self.stopwatch("waiting"):
            self.settle()
        self.world.is_ended = True
        with self.stopwatch("tracking"):
            tracked = self.segments.finish()
        self.executor = self.executor.in_order()
        if tracked.is_new_main:
            self.executor.begin_anew(self._new_mapper(self.world.keyframes))
            self.segments.main.keyframes.take_corrections()
            self.world.unmapped.clear()
        self.world.map = self.executor.mapper.table
        self._advance(tracked, is_last=True)
        if not self.executor.maps_at_end:  # else there is no online result
            self.stopwatch.end_stream()

    @changes_system
    @on_one_torch_thread
    def adjust(self, progress: StageProgress = unwatched) -> None:
        """Bundle-adjust all keyframes and correct the map."""
        main = self.segments.main
        if not main.segment.ids:
            return
        with self.stopwatch("global bundle adjustment"):
            global_bundle(main, progress, ends=self.world.is_ended)
        if self.world.is_ended:
            with self.stopwatch("uncertainty"):
                self.world.uncertainty = frame_uncertainty(main)
        self.loops.replaced_by_bundle()
        self.world.adjusted = len(main.segment.ids)
        self._update_map()

    @changes_system
    @on_one_torch_thread
    def refine(self, progress: StageProgress = unwatched, seconds: float | None = None) -> None:
        """Train the map over all keyframes, or make it from them where it was deferred.

        With limited ``seconds``, as after an interruption, only where there is no map yet.
        """
        label = "mapping" if self.executor.maps_at_end else "map refinement"
        self.executor.refine(self.world.unmapped, partial(progress, label), seconds)
        self.world.is_refined = self.will_refine and seconds is None

    @changes_system
    @on_one_torch_thread
    def finish(self, progress: StageProgress = unwatched, correct: bool = True) -> None:
        """End the stream if needed, adjust all keyframes, refine the map, convert it to metres.

        ``correct=False`` (after an interruption) keeps the online result.
        """
        if not self.world.is_ended:
            self.end_stream()
        if correct:
            self.adjust(progress)
            self.refine(progress)
        self.to_metres()

    @changes_system
    @on_one_torch_thread
    def place_found(self, found: FoundFrames) -> None:
        """Insert lost frames that were relocalised."""
        self.segments.place_found(found)
        if self.world.uncertainty is not None:
            self.world.uncertainty = self.world.uncertainty.with_found(found)

    @changes_system
    @on_one_torch_thread
    def rescale(self, scale: MetricScale) -> None:
        """Convert all lengths of poses, depths and map to metres."""
        self.settle()
        world = self.world
        keyframes = self.segments.main.keyframes
        shrunk = torch.eye(4, dtype=torch.float64)
        shrunk[:3, :3] /= scale.factor
        keyframes.correct(keyframes.moved(shrunk))
        known = world.uncertainty
        if known is not None:
            world.uncertainty = replace(known, position=scale.factor * known.position)
        world.metric_scale = scale
        self._update_map()

    def to_metres(self) -> None:
        """Convert the map to metres where odometry poses determine its scale.

        A map in metres, or one that continues a saved map, is left unchanged.
        """
        scale = None if self.metric_scale else scale_by_odometry(self.segments.main)
        if scale is not None:
            self.rescale(scale)


def scale_by_odometry(main: Tracker) -> MetricScale | None:
    """Return the scale from odometry poses; None without, or in the gauge of a saved map."""
    odometry = main.map.odometry
    found = odometry.found
    if found.scale is None or main.segment.fixed:
        return None
    drift = (odometry.config.drift**2 + found.deviation**2) ** 0.5
    scale = found.scale
    found.scale = 1.0
    return MetricScale("poses beside the images", scale, drift)
