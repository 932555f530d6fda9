"""Image files, MetaImage and NRRD: headers, pixels, sequences."""
