"""What leaves the house: assets, videos, pictures."""
