"""What an AWS account has and allows: identity, regions, zones, quotas, hosted zones, versioned buckets, names."""
