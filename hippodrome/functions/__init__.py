"""The code of the Lambda functions. A handler reads its event, calls the control plane and shapes the reply."""
