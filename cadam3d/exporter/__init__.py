"""Exporters: write the finished asset, and pictures and videos of it, into the run folder."""
