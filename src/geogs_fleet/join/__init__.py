"""One place from several results: places recognised, one Sim(3) graph, one map, one surface.

Nothing here knows Ray: what can be done side by side is a function of a job that can be pickled,
and :class:`geogs_fleet.join.workers.Workers` says where it is done.
"""
