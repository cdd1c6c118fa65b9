"""Flights: evaluation, logs, films, data sets, labelled pictures, identification."""
