"""The speed study: our step against other solvers on the same windows."""
