"""The handlers, one file per Lambda function. Each reads its event, calls `hippodrome` and shapes the reply."""
