"""Ray casters.

``solid_kernels`` intersects rays with single solids, compiled, for both casters on the CPU:
``raycaster`` for a scene with hundreds of solids and moving bodies, ``cpu_caster`` for batches of
rooms. ``cuda_caster`` is the latter's version for a GPU; ``caster_choice`` takes one of the two.
"""
