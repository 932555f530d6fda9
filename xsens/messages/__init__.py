"""Bytes to messages: framing, ids and control messages, data messages, the calibration block."""
