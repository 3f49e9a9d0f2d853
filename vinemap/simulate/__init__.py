"""Vineyards, surveys and drives of a robot whose truth is known, for examples, tests and measurements."""
