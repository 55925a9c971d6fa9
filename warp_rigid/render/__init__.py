"""Pictures, films and glTF files of recordings."""
