"""The appearance-coupled baseline: 2D Gaussian splatting with colour (Huang et al. 2024).

Disks with spherical harmonics are trained on the images' colours by the public losses and
schedule, through the operators of gsplat, and meshed like the system's own maps. It shows the
geometry that the same time gives as a by-product of appearance.
"""
