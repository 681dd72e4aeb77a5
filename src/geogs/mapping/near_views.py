"""The views around one, of however many there are."""

from collections.abc import Collection, Mapping

import numpy as np

from geogs.mapping.view import MapView


class NearViews:
    """Finds those of some views that were taken nearest to one.

    It looks over the table of all poses rather than asking view by view, and keeps the list of ids
    that it was asked about last.
    """

    def __init__(self, views: Mapping[int, MapView]) -> None:
        """``views`` by keyframe; more may come."""
        self._views = views
        self._ids = np.zeros(0, np.int64)

    def around(self, view: MapView, ids: Collection[int], count: int) -> list[MapView]:
        """The ``count`` of the views ``ids`` nearest to one, which may be among them.

        They come in the order of the ``ids``, which grow from one call to the next; nothing else
        becomes of these.
        """
        if len(ids) <= count:
            return [self._views[i] for i in ids]
        if len(ids) != len(self._ids):
            self._ids = np.fromiter(ids, np.int64, len(ids))
        nearest = view.keyframe.poses.nearest(view.id, self._ids, count)
        wanted = np.isin(self._ids, nearest, assume_unique=True)
        return [self._views[i] for i in self._ids[wanted].tolist()]
