"""An image for a mesh: a view for each face, patches in an atlas, exposure compensation."""
