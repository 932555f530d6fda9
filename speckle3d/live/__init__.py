"""Sweeps as they are made: matched and placed frame by frame, recorded, and sent on."""
