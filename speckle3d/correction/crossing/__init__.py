"""Length from a second sweep that crosses the first over the same tissue.

In-plane geometry is exact. A second sweep, turned by 30 to 90 degrees, lays that exact axis along the first
one's elevational one, so that agreement of the images where they cross gives the elevational scale of both.
"""
