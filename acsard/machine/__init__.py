"""What an administrator does with the computer: doctor, certificates, serial ports, the service."""
