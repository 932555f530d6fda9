"""Results handed over to pandas, xarray, matplotlib, pyvista and napari."""
