"""Commands of sweeps that are being made, over OpenIGTLink."""
