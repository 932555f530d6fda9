"""Volumes as files: NRRD, MetaImage and NIfTI, written plane by plane; labels."""
