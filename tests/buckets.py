"""A bucket in memory, whose subclasses fail, count or remember requests."""

from fsspec.implementations.memory import MemoryFileSystem


class MemoryBucket(MemoryFileSystem):
    """The base of buckets. A subclass sets ``protocol``, and has its own ``store``."""

    @classmethod
    def _strip_protocol(cls, path):
        return MemoryFileSystem._strip_protocol(path.replace(f"{cls.protocol}://", "memory://"))

    def unstrip_protocol(self, name):
        return f"{self.protocol}:/{name}"
