"""Stages of the loop: each is one feature, a class in a module of its own.

A stage reads and assigns named arrays of the record (`record.py`) and knows no other stage. A
feature that is off is a stage that is not in the loop's list.
"""
