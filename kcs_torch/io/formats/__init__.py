"""The formats, one file a family. Each file holds a tuple ``READERS``, a tuple ``WRITERS``, or both."""
