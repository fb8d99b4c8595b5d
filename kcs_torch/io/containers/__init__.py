"""JSON, .npz, HDF5 and MATLAB files that nobody vouches for: read within bounds, and nothing in them is run."""
