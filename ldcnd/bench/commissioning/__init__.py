"""A checklist that takes an axis from its first motion to a finished configuration and a report.

For those who build a machine, through `ldcnd commission`; it stands on the client and knows no terminal. Start with
`checklist`; `step` says what a step is, `record` what is kept of it.
"""
