from tests.mesh.async_tests import pytest_pyfunc_call, real_time, stack

__all__ = ["pytest_pyfunc_call", "real_time", "stack"]
