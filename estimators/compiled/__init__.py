"""Compiled kernels: how they are declared, cached and linked, and their linear algebra."""
