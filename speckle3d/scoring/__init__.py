"""How far a reconstruction is from a reference: lengths, displacements, trajectories, statistics."""
