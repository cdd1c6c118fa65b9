"""Flights: evaluation, logs, films."""
