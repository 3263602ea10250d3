"""Shapes and frames, with values and derivatives that are finite everywhere.

`planar` turns vectors in the plane, `vectors` writes spatial ones out entry by entry, `footprint`
is the outline that the skin feels, and `solid` has the mass properties that an engine needs.
"""
