"""Device-resident rings of experience, the mix of source and online rows, datasets on disk."""
