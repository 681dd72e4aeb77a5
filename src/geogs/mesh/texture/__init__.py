"""An image for a mesh: a view for each face, patches in an atlas, levelled where they meet."""
