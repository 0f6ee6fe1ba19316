/* Commands of the host, and the answers to them. */
#ifndef COMMANDS_H
#define COMMANDS_H

/* Take a byte of the host if one has come, and write one answer if there is time for it. */
void commands_service(void);

#endif
