/* Commands of the host, and the answers to them. */
#ifndef COMMANDS_H
#define COMMANDS_H

/* Take bytes of the host if any have come, and write one answer if there is time for it. */
void commands_service(void);

#endif
