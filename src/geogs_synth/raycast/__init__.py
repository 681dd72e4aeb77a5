"""Ray casters.

``solid_kernels`` meets single solids, compiled, and is used by all that runs on the CPU:
``raycaster`` for a scene with hundreds of solids and moving bodies, ``cpu_caster`` for batches of
rooms. ``cuda_caster`` does what the latter does, on a GPU; ``caster_choice`` takes one of the two.
"""
