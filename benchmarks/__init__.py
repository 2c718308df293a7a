"""Benchmarks: ``python -m benchmarks.FOLDER.MODULE`` from the root of the repository.

Each writes a page to ``out/NAME``; ``--keep`` writes it to ``benchmarks/results`` as well.
"""
