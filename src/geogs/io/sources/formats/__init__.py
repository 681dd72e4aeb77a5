"""The formats that can be read, one file each: images, and poses where a data set has them."""
