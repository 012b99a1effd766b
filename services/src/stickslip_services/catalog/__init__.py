"""What has been made: dataset versions and certificates."""
