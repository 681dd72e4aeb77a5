"""Settings of reading a source."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.config.setting import Basic, Formerly, Moment, NamesFile, Only, Range, Settings


@dataclass(frozen=True)
class InputConfig(Settings, group="input"):
    """Reading of the source."""

    intrinsics: Annotated[str, NamesFile(("auto",)), Basic("--intrinsics")] = "auto"
    """The lens; auto, a file, fx,fy,cx,cy[,k1,k2,p1,p2[,k3]] in pixels of the source image, or
    fisheye,fx,fy,cx,cy[,k1,k2,k3,k4] (OpenCV's, Kannala and Brandt's)."""
    long_edge: Annotated[int, Range(32, 16384, or_zero=True), Basic("--long-edge")] = 512
    """Longer side of the working image in pixels; smaller sources are not enlarged, 0 keeps all."""
    working_field_of_view: Annotated[
        float | Literal["auto"],
        Range(5, 150),
        Basic("--working-field-of-view", is_common=False),
        Formerly(
            {
                "--field-of-view": "--working-field-of-view",
                "--input.field-of-view": "--input.working-field-of-view",
            }
        ),
    ] = "auto"
    """Field of view of the straight images of which the map is made, not of the lens: degrees along
    the longer side; auto keeps all that fits without a border, and of a fisheye at most 90."""
    readout: Annotated[float | Literal["auto"], Range(-0.1, 0.1), Only("run")] = "auto"
    """Seconds a rolling shutter takes from the first to the last row as the sensor reads them, such
    as 0.0276; 0 for a global shutter, auto finds it in the video."""
    depth: Annotated[Literal["none", "auto", "sensor"], Only("run"), Basic("--depth")] = "none"
    """Depth that a sensor measured, beside the images: none leaves it, auto takes it where there
    is any, sensor must have it. With it the result is in metres."""
    depth_unit: Annotated[
        float | Literal["auto"],
        Range(1e-3, 1e6),
        Only("run"),
        Basic("--depth-unit", is_common=False),
    ] = "auto"
    """Units of the depth images per metre, such as 1000 for millimetres; auto takes that of a file
    beside them, else that of the data set where the depths can be a sensor's by it."""
    poses: Annotated[str, NamesFile(("none", "auto", "prior")), Only("run"), Basic("--poses")] = (
        "auto"
    )
    """Poses beside the images, as priors: on the motion and the scale. none leaves them, auto takes
    those of an app that tracks its camera (Stray Scanner, Record3D, Polycam), prior must have some,
    and a file (TUM's rows) is taken as given. With them the result is in metres."""
    topic: Annotated[str, Only("run"), Basic("--topic", is_common=False)] = "auto"
    """Topic of the images in a bag of ROS; auto takes the one that most likely is the camera."""
    pipe: Annotated[str, Only("run")] = "auto"
    """Format of raw frames from a pipe (SOURCE -): WIDTHxHEIGHT:FORMAT[@FPS], such as
    640x480:rgb24@30; FORMAT is rgb24, bgr24, gray or yuv420p. auto reads YUV4MPEG2's own header."""
    mask: Annotated[Path | None, Only("run"), Basic("--mask")] = None
    """Picture that is bright where the scene is: of the source images' size, and black where they
    always show something else, a car's bonnet, a robot's arm, a time stamp. Or a folder with one
    for each image, by its name or the number of the frame; where one is missing, all is shown."""
    mask_overlay: Annotated[bool, Only("run")] = True
    """Whether what all images show at the same place while all else moves, such as a time stamp, is
    masked out, where no mask is given."""
    take: Annotated[str, Only("run"), Basic("--take")] = "auto"
    """Part of each image to use: left, right, top or bottom of a stereo pair in one picture; front,
    back or 360:YAW,PITCH (degrees to the right and upwards), a view of 90 degrees of a 360-degree
    panorama; a half and a view joined by +, such as top+front. auto takes all and refuses stereo
    pairs and panoramas, none takes all unasked. Given intrinsics hold for the part."""
    start: Annotated[int | str, Moment(), Range(0), Basic("--start")] = 0
    """First frame of the source, from 0, or its time."""
    stop: Annotated[int | str | None, Moment(), Range(above="start"), Basic("--stop")] = None
    """Frame or time before which to stop; none reads to the end."""
    stride: Annotated[int, Range(1), Basic("--stride")] = 1
    """Use every stride-th frame."""
