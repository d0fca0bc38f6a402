"""What the commands share: options, findings, explained errors, stages, project folders, projects and servers."""
