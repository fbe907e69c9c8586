from contextlib import contextmanager
@contextmanager
def imitated():
    yield
