"""Native libraries: how C++ sources of the package become libraries for this machine."""
