"""The design verification report: experiments P1 to P14 and what they must show."""
