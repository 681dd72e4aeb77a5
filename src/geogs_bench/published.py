"""The figures printed in papers' tables, as constants; nothing here was measured by us.

Unless a table names another source it is of the paper that the system follows.

Rows are the paper's methods, columns are scenes (or variants, in the ablations). A star
marks methods that the paper ran online, without their offline refinement of the map.
"""

from collections.abc import Iterable
from dataclasses import dataclass

PAPER = "GeoGS-SLAM"
"""The method whose figures are shown beside ours."""


@dataclass(frozen=True)
class PublishedRow:
    """One method and metric; values in the order of the table's columns."""

    method: str
    metric: str
    values: tuple[float, ...]
    mean: float | None = None
    """The printed mean; none if the table has none."""


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper."""

    label: str
    """Its LaTeX label."""
    caption: str
    columns: tuple[str, ...]
    rows: tuple[PublishedRow, ...]
    source: str = "the paper"
    """Publication that printed it."""

    def value(self, column: str, metric: str, method: str = PAPER) -> float | None:
        """A printed figure, or none if the paper gives none."""
        row = self._row(metric, method)
        if row is None or column not in self.columns:
            return None
        return row.values[self.columns.index(column)]

    def mean(self, columns: Iterable[str], metric: str, method: str = PAPER) -> float | None:
        """The printed mean, or the mean over ``columns`` if these are only part of the table."""
        row = self._row(metric, method)
        kept = set(columns)
        if row is None:
            return None
        if row.mean is not None and kept.issuperset(self.columns):
            return row.mean
        values = [v for name, v in zip(self.columns, row.values, strict=True) if name in kept]
        return sum(values) / len(values) if values else None

    def _row(self, metric: str, method: str) -> PublishedRow | None:
        found = (r for r in self.rows if r.metric == metric and r.method == method)
        return next(found, None)


def _three(method: str, *rows: tuple[float, ...]) -> tuple[PublishedRow, ...]:
    """Accuracy, completeness and completeness ratio of a method; the last value is the mean."""
    metrics = ("Acc", "Comp", "Comp.Rat")
    return tuple(
        PublishedRow(method, metric, values[:-1], values[-1])
        for metric, values in zip(metrics, rows, strict=True)
    )


def _by_method(metric: str, printed: dict[str, tuple[float, ...]]) -> tuple[PublishedRow, ...]:
    """Rows of one metric; the last value of each is the mean."""
    return tuple(PublishedRow(name, metric, v[:-1], v[-1]) for name, v in printed.items())


REPLICA_SCENES = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")

REPLICA_SURFACE = PublishedTable(
    "tab:replica_recon",
    "Online reconstruction on Replica; Acc. and Comp. in cm, Comp.Rat. (5 cm) in %",
    REPLICA_SCENES,
    (
        *_three(
            "DROID-SLAM",
            (3.51, 2.80, 3.67, 2.57, 2.32, 3.78, 3.80, 4.19, 3.33),
            (7.47, 5.90, 11.85, 4.52, 7.60, 10.37, 10.11, 10.06, 8.49),
            (71.05, 76.31, 65.75, 78.71, 67.72, 66.64, 64.24, 67.74, 69.77),
        ),
        *_three(
            "NICER-SLAM",
            (2.53, 3.93, 3.40, 5.49, 3.45, 4.02, 3.34, 3.03, 3.65),
            (3.04, 4.10, 3.42, 6.09, 4.42, 4.29, 4.03, 3.87, 4.16),
            (88.75, 76.61, 86.10, 65.19, 77.84, 74.51, 82.01, 83.98, 79.37),
        ),
        *_three(
            "GO-SLAM",
            (4.60, 3.31, 3.97, 3.05, 2.74, 4.61, 4.32, 3.91, 3.81),
            (5.56, 3.48, 6.90, 3.31, 3.46, 5.16, 5.40, 5.01, 4.79),
            (73.35, 82.86, 74.23, 82.56, 86.19, 75.76, 72.63, 76.61, 78.00),
        ),
        *_three(
            "HI-SLAM",
            (3.21, 3.74, 3.16, 3.87, 2.60, 4.62, 4.25, 3.53, 3.62),
            (3.25, 3.08, 4.09, 5.29, 8.83, 4.42, 4.06, 3.72, 4.59),
            (86.99, 87.19, 80.82, 72.55, 72.44, 80.90, 81.04, 82.88, 80.60),
        ),
        *_three(
            "Splat-SLAM*",
            (3.56, 3.33, 3.11, 5.16, 4.02, 4.29, 3.24, 3.47, 3.77),
            (4.57, 4.41, 4.07, 3.00, 4.76, 4.74, 4.44, 5.52, 4.43),
            (77.37, 79.08, 83.72, 69.03, 70.91, 72.83, 80.99, 78.33, 76.53),
        ),
        *_three(
            "HI-SLAM2*",
            (2.00, 2.03, 5.09, 2.75, 1.78, 2.74, 2.53, 3.60, 2.82),
            (3.90, 3.69, 4.77, 3.32, 3.54, 4.76, 4.30, 5.21, 4.19),
            (85.26, 85.05, 80.84, 82.84, 84.11, 79.59, 80.92, 79.92, 82.31),
        ),
        *_three(
            PAPER,
            (1.63, 1.47, 2.10, 2.70, 1.63, 1.94, 2.36, 2.89, 2.09),
            (3.92, 3.22, 3.83, 3.46, 3.20, 4.34, 4.47, 5.17, 3.95),
            (86.77, 86.44, 85.09, 83.05, 85.97, 81.92, 80.08, 80.02, 83.67),
        ),
    ),
)

REPLICA_TRACKING = PublishedTable(
    "tab:replica_tracking",
    "Online tracking on Replica, mean ATE over eight sequences in cm",
    ("mean",),
    _by_method(
        "ATE",
        {
            "DROID-SLAM": (0.38, 0.38),
            "MGS-SLAM": (0.32, 0.32),
            "Splat-SLAM*": (0.38, 0.38),
            "HI-SLAM2*": (0.32, 0.32),
            "GSO-SLAM": (0.46, 0.46),
            PAPER: (0.28, 0.28),
        },
    ),
)

SCANNETPP_SCENES = ("8b5caf3398", "39f36da05b", "6d89a7320d", "fb564c935d")

SCANNETPP = PublishedTable(
    "tab:scannetpp_joint",
    "Online tracking and reconstruction on ScanNet++ (iPhone), ATE and CD in cm",
    SCANNETPP_SCENES,
    (
        PublishedRow("HI-SLAM2*", "ATE", (3.96, 3.06, 9.20, 3.03), 4.81),
        PublishedRow("HI-SLAM2*", "CD", (13.66, 8.15, 18.97, 8.94), 12.43),
        PublishedRow(PAPER, "ATE", (3.93, 3.06, 7.64, 3.02), 4.41),
        PublishedRow(PAPER, "CD", (8.47, 7.04, 12.51, 6.67), 8.67),
    ),
)

SCANNET_SCENES = tuple(
    f"scene{number}_00"
    for number in ("0000", "0054", "0059", "0106", "0169", "0181", "0207", "0233")
)

SCANNET = PublishedTable(
    "tab:scannet_tracking",
    "Online tracking on ScanNet, ATE in cm",
    SCANNET_SCENES,
    _by_method(
        "ATE",
        {
            "NICE-SLAM": (12.00, 20.90, 14.00, 7.90, 10.90, 13.40, 6.20, 9.00, 11.8),
            "E-SLAM": (7.30, 36.30, 8.50, 7.50, 6.50, 9.00, 5.70, 4.30, 10.6),
            "GLORIE-SLAM": (5.50, 9.40, 9.10, 7.00, 8.20, 8.30, 7.50, 5.10, 7.50),
            "Splat-SLAM": (5.57, 9.50, 9.11, 7.09, 8.26, 8.39, 7.53, 5.17, 7.58),
            "HI-SLAM2*": (5.20, 8.50, 8.27, 7.58, 8.01, 6.87, 6.90, 5.15, 7.06),
            PAPER: (5.20, 8.47, 8.25, 7.13, 8.00, 6.86, 6.89, 5.21, 7.00),
        },
    ),
)

RGBD_METHODS = ("NICE-SLAM", "E-SLAM")
"""Methods of ScanNet's table that use the depth of the sensor."""

TUM_RGBD = PublishedTable(
    "TUM-RGBD",
    "Tracking with the depth of the sensor on TUM RGB-D, ATE in cm",
    (
        "rgbd_dataset_freiburg1_desk",
        "rgbd_dataset_freiburg1_desk2",
        "rgbd_dataset_freiburg1_room",
        "rgbd_dataset_freiburg2_xyz",
        "rgbd_dataset_freiburg3_long_office_household",
    ),
    _by_method(
        "ATE",
        {
            "Kintinuous": (3.70, 7.10, 7.50, 2.90, 3.00, 4.84),
            "ElasticFusion": (2.53, 6.83, 21.49, 1.17, 2.52, 6.91),
            "ORB-SLAM2": (1.60, 2.20, 4.70, 0.40, 1.00, 1.98),
            "NICE-SLAM": (4.26, 4.99, 34.49, 31.73, 3.87, 15.87),
            "Vox-Fusion": (3.52, 6.00, 19.53, 1.49, 26.01, 11.31),
            "Point-SLAM": (4.34, 4.54, 30.92, 1.31, 3.48, 8.92),
            "SplaTAM": (3.35, 6.54, 11.13, 1.24, 5.16, 5.48),
        },
    ),
    "SplaTAM (Keetha et al., CVPR 2024)",
)

DTU_SCENES = tuple(
    f"scan{number}" for number in (24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122)
)

DTU = PublishedTable(
    "tab:dtu_main",
    "Chamfer distance on DTU after 2 minutes; the paper prints cm, the protocol gives mm",
    DTU_SCENES,
    _by_method(
        "CD",
        {
            "2DGS": (1.29, 1.18, 1.22, 0.83, 2.43, 2.03, 1.19, 1.54, 1.53, 1.20, 1.09, 2.05,
                      1.07, 1.04, 1.04, 1.38),
            "PGSR": (2.22, 1.78, 2.56, 2.72, 3.66, 2.77, 1.88, 1.09, 1.80, 2.42, 0.75, 3.08,
                      2.89, 0.97, 0.49, 2.07),
            "QGS": (2.15, 1.34, 1.65, 1.45, 2.75, 2.33, 1.49, 1.32, 1.94, 1.20, 1.85, 2.27,
                     1.81, 1.26, 1.18, 1.73),
            PAPER: (0.53, 0.89, 0.36, 0.34, 0.96, 0.66, 0.56, 1.25, 0.96, 0.62, 0.46, 0.62,
                     0.34, 0.42, 0.41, 0.62),
        },
    ),
)  # fmt: skip

DTU_EFFICIENCY = PublishedTable(
    "tab:param_eff",
    "Size of the model of DTU scan55 after 2 minutes (CD printed in cm, in fact mm)",
    ("scan55",),
    tuple(
        PublishedRow(method, metric, (value,))
        for method, values in (
            ("2DGS", (161.0, 37.5, 0.83)),
            ("PGSR", (231.0, 54.6, 2.72)),
            ("QGS", (200.0, 8.1, 1.45)),
            (PAPER, (23.0, 1.2, 0.34)),
        )
        for metric, value in zip(("thousand disks", "MB", "CD"), values, strict=True)
    ),
)

ABLATION_INIT = PublishedTable(
    "tab:ablation_init",
    "Initialisation of the disks and iterations a keyframe, means over Replica in cm and %",
    ("random-7", "random-10", "local-plane-7", "local-plane-10"),
    (
        PublishedRow(PAPER, "Acc", (2.77, 2.37, 2.09, 1.98)),
        PublishedRow(PAPER, "Comp", (4.23, 4.03, 3.95, 3.93)),
        PublishedRow(PAPER, "Comp.Rat", (82.28, 83.35, 83.67, 83.91)),
    ),
)

ABLATION_UPDATE = PublishedTable(
    "tab:ablation_map_update",
    "How the map follows corrected poses, means over Replica in cm and %",
    ("per-keyframe", "coherent"),
    (
        PublishedRow(PAPER, "Acc", (2.16, 2.09)),
        PublishedRow(PAPER, "Comp", (4.05, 3.95)),
        PublishedRow(PAPER, "Comp.Rat", (83.15, 83.67)),
    ),
)

ABLATION_POSE_LR = PublishedTable(
    "tab:ablation_pose_lr",
    "Learning rate of the pose step, mean ATE over Replica in cm",
    ("1e-3", "6e-4", "4e-4", "2e-4", "1e-4"),
    (PublishedRow(PAPER, "ATE", (0.29, 0.28, 0.28, 0.28, 0.29)),),
)

ABLATION_LOSSES = PublishedTable(
    "tab:ablation_loss",
    "Loss terms on DTU scan24 after 2 minutes; CD printed in cm, in fact mm",
    ("no-multi-view", "no-normal-consistency", "no-smoothness", "all"),
    (PublishedRow(PAPER, "CD", (9.04, 0.67, 0.56, 0.53)),),
)
