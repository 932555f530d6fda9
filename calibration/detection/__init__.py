"""From images to points: lines, dots, and which wire each dot is."""
