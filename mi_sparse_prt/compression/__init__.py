"""The matrix made small for relighting: clustered principal components, wavelets."""
