"""Prefect flows that chain the stages of vinemap."""
