"""The appearance-coupled baseline: 2D Gaussian splatting with colour (Huang et al. 2024).

Disks with spherical harmonics are trained on the images' colours by the public losses and
schedule, through the operators of gsplat, and meshed like the system's own maps. It shows what
the same time buys where geometry comes as a by-product of appearance.
"""
