"""One place from several results: places recognised, one Sim(3) graph, one map, one surface.

Nothing here knows Ray: what can be done concurrently is a function of values that can be pickled,
and :class:`geogs_fleet.workers.Workers` says where it is called.
"""
