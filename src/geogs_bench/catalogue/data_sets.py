"""Every benchmark of known data sets; the ablations are in their own file."""

from geogs_bench import published as paper
from geogs_bench.benchmark import Benchmark, Variant
from geogs_bench.catalogue.variants import DEFAULT, ONLINE, PAPER, PIPELINES
from geogs_bench.data.benchmark_scene import Option
from geogs_bench.data.motion_cells import DEPTH_CELLS, FULL, ROOM, SMALL
from geogs_bench.data.scenes import (
    find_depth,
    find_dtu,
    find_motions,
    find_objects,
    find_posed_rooms,
    find_replica,
    find_rooms,
    find_scannet,
    find_scannetpp,
    find_seven_scenes,
    find_tum,
)
from geogs_bench.tables.columns import (
    COST,
    area_layout,
    dtu_layout,
    motion_layout,
    photo_layout,
    place_layouts,
    rgbd_layout,
    trajectory_layout,
    vertex_layout,
)

_ONLINE = (
    "Published online figures include the paper's final global bundle adjustment and map update, "
    "and stand beside that stage alone; the refinement after it is ours."
)
_PLAIN_DISTANCES = (
    "The paper prints squared distances in its formulas; its toolbox and its figures are plain "
    "distances, and so are ours."
)

RGBD = "rgb-d"
_RGBD = Variant(RGBD, (Option("depth", "sensor"),), needs_depth=True)
_WITH_AND_WITHOUT_DEPTH = (Variant("rgb"), _RGBD)
_DEPTH = (
    "Rows rgb-d use the depth of the sensor, too (--depth sensor), where it is there; all others "
    "the images alone. Results with depth are in metres and need no more than a rigid alignment."
)

REPLICA = Benchmark(
    "replica",
    "Replica: tracking and reconstruction",
    "run",
    find_replica,
    "the unpacked Replica.zip of NICE-SLAM: <scene>/results, <scene>/traj.txt, <scene>_mesh.ply, "
    "best with cull_replica_mesh/ beside them",
    "https://github.com/cvg/nice-slam (scripts/download_replica.sh, download_cull_replica_mesh.sh)",
    (
        trajectory_layout(paper.REPLICA_TRACKING),
        vertex_layout(paper.REPLICA_SURFACE),
        area_layout(),
        COST,
    ),
    (DEFAULT, ONLINE, PAPER),
    scenes=paper.REPLICA_SCENES,
    published=(paper.REPLICA_SURFACE, paper.REPLICA_TRACKING),
    notes=(PIPELINES, _ONLINE, _PLAIN_DISTANCES),
)

SCANNET = Benchmark(
    "scannet",
    "ScanNet: tracking",
    "run",
    find_scannet,
    "scenes exported from their .sens files: <scene>/color, <scene>/pose, <scene>/intrinsic",
    "http://www.scan-net.org (terms of use), exported with its SensReader",
    (
        trajectory_layout(paper.SCANNET),
        rgbd_layout(RGBD, paper.SCANNET, paper.RGBD_METHODS),
        area_layout(),
        COST,
    ),
    (DEFAULT, ONLINE, PAPER, _RGBD),
    scenes=paper.SCANNET_SCENES,
    published=(paper.SCANNET,),
    notes=(
        PIPELINES,
        _ONLINE,
        _DEPTH,
        "The published systems cut the black borders of the images off; here they stay.",
    ),
)

SCANNETPP = Benchmark(
    "scannetpp",
    "ScanNet++ (iPhone): tracking and reconstruction",
    "run",
    find_scannetpp,
    "data/<id>/iphone with rgb.mkv (or the extracted rgb/) and colmap/, and "
    "data/<id>/scans/mesh_aligned_0.05.ply",
    "https://kaldir.vc.in.tum.de/scannetpp (terms of use)",
    (trajectory_layout(paper.SCANNETPP), vertex_layout(paper.SCANNETPP), area_layout(), COST),
    (DEFAULT, ONLINE, PAPER),
    scenes=paper.SCANNETPP_SCENES,
    published=(paper.SCANNETPP,),
    notes=(
        PIPELINES,
        _ONLINE,
        "The paper states neither the frames it used, nor its true poses, nor how it cut the "
        "laser scan; here: every second frame, COLMAP's poses, triangles that the camera saw.",
    ),
)

TUM = Benchmark(
    "tum",
    "TUM RGB-D: tracking",
    "run",
    find_tum,
    "unpacked sequences: <sequence>/rgb.txt, <sequence>/groundtruth.txt, for depth depth.txt",
    "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/download",
    (trajectory_layout(), rgbd_layout(RGBD, paper.TUM_RGBD), COST),
    _WITH_AND_WITHOUT_DEPTH,
    published=(paper.TUM_RGBD,),
    notes=(_DEPTH,),
)

SEVEN_SCENES = Benchmark(
    "7scenes",
    "7-Scenes: tracking and reconstruction",
    "run",
    find_seven_scenes,
    "<scene>/seq-01/frame-000000.color.png, frame-000000.pose.txt, and for depth "
    "frame-000000.depth.png",
    "https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes",
    (trajectory_layout(), rgbd_layout(RGBD), area_layout(), COST),
    _WITH_AND_WITHOUT_DEPTH,
    notes=(
        _DEPTH,
        "The true poses come from KinectFusion, a few centimetres off themselves, and are those "
        "of the depth camera.",
    ),
)

DTU = Benchmark(
    "dtu",
    "DTU: surfaces from known poses in two minutes",
    "reconstruct",
    find_dtu,
    "scans as prepared for 2DGS or IDR (scan24/images, scan24/cameras.npz), and for distances the "
    "official SampleSet/MVS Data (ObsMask, Points/stl) beside them",
    "https://github.com/hbb1/2d-gaussian-splatting (prepared scans); "
    "https://roboimagedata.compute.dtu.dk (SampleSet.zip, Points.zip)",
    (dtu_layout(paper.DTU), photo_layout(), area_layout(posed=True), COST),
    (DEFAULT, PAPER),
    scenes=paper.DTU_SCENES,
    published=(paper.DTU,),
    notes=(
        "The paper prints its chamfer distances as cm; the protocol it follows gives mm.",
        "Our seconds hold everything from reading the images to writing the mesh.",
    ),
    budgets=(120.0,),
)

ROOMS = Benchmark(
    "rooms",
    "Rooms with exact surfaces: tracking and reconstruction",
    "run",
    find_rooms,
    "<scene>/results, <scene>/traj.txt, <scene>/mesh.ply and points_seen_*.ply, as geogs synth "
    "writes them; without a folder a synthetic room is made",
    "geogs synth, or any rendered room in this layout",
    (trajectory_layout(), area_layout(), vertex_layout(), COST),
    cells=(ROOM,),
)

POSED_ROOMS = Benchmark(
    "rooms-known-poses",
    "Rooms with exact surfaces: reconstruction from known poses",
    "reconstruct",
    find_posed_rooms,
    ROOMS.needs,
    ROOMS.source,
    (area_layout(posed=True), vertex_layout(posed=True), COST),
    notes=("About a hundred images of each sequence are used.",),
    budgets=(120.0,),
    cells=(ROOM,),
)

MOTIONS = Benchmark(
    "motions",
    "Motions and flaws of the camera, with exact truth: tracking alone",
    "track",
    find_motions,
    "sequences as geogs synth writes them; without a folder a matrix of motions and cameras is "
    "rendered, with --small a small one",
    "geogs synth --motion KIND --camera FLAWS",
    (motion_layout(), COST),
    cells=FULL,
)

MOTIONS_SMALL = Benchmark(
    "motions-small",
    "Motions and flaws of the camera, few small sequences",
    "track",
    find_motions,
    MOTIONS.needs,
    MOTIONS.source,
    (motion_layout(), COST),
    cells=SMALL,
)

EDGES = Benchmark(
    "edges",
    "Depth by kind of place: edges, thin things, what is behind them, bare walls, sky",
    "run",
    find_depth,
    "sequences with exact or measured depth: rooms and streets as geogs synth writes them, rooms "
    "with a true surface, TUM RGB-D or 7-Scenes with depth images; without a folder rooms and a "
    "street are rendered",
    "geogs synth, or any sequence with depth in these layouts",
    place_layouts(),
    notes=(
        "The mesh is seen from the estimated poses, after one scale for the whole sequence, so "
        "that errors of the trajectory do not count.",
    ),
    cells=DEPTH_CELLS,
)

OBJECTS = Benchmark(
    "objects",
    "Objects with masks: surfaces from known poses",
    "reconstruct",
    find_objects,
    "<scene>/results with frame and mask images, <scene>/traj.txt, <scene>/mesh_*.ply and "
    "points_seen_*.ply",
    "any rendered or scanned object in this layout",
    (area_layout(posed=True), COST),
    notes=(
        "Distances of 20 mm and more, and what lies outside the masks, are left out as in DTU's "
        "protocol.",
    ),
    budgets=(120.0,),
)

DATA_SETS = (
    REPLICA, SCANNET, SCANNETPP, TUM, SEVEN_SCENES, DTU, ROOMS, POSED_ROOMS, MOTIONS,
    MOTIONS_SMALL, EDGES, OBJECTS,
)  # fmt: skip
