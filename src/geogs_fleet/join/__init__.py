"""One map from several results: place recognition, one Sim(3) graph, one map, one surface.

Nothing here depends on Ray: concurrent jobs are functions of values that can be pickled, and
:class:`geogs_fleet.workers.Workers` calls them.
"""
