"""Administration of this computer: the doctor, certificates, serial ports and the service."""
