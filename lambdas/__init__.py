"""The Lambda functions, by the names that infra/template.yml gives them. Their code is in hippodrome/functions/."""
