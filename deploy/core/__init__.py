"""What the commands share: options, findings, explained errors, the project folder, registered projects and servers."""
