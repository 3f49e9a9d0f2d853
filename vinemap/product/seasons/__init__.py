"""Surveys of one estate beside each other: their products, and their rows over the dates."""
