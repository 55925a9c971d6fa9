"""Images, videos and glTF files of recordings."""
