"""PlayCanvas' SOG: splats in lossless pictures; with levels of detail, streamed SOG."""
