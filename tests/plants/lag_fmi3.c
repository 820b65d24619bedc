/* T y' = K r~(t - d) - y as an FMU for co-simulation, after the FMI 3.0 specification; r~ may move at multiples of SUB. */

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define K 0.5
#define T 0.3
#define SUB 0.05
#define D 5 /* of SUB */

enum { TIME, R_TILDE, Y, VARIABLES };
enum { OK = 0, ERROR = 3 };

typedef struct {
    double value[VARIABLES], line[D];
    bool initialized;
} Lag;

#define REFUSED(name) int fmi3##name(void) { return ERROR; }
#define OF_TYPE(type) REFUSED(Get##type) REFUSED(Set##type)

OF_TYPE(Float32) OF_TYPE(Int8) OF_TYPE(UInt8) OF_TYPE(Int16) OF_TYPE(UInt16) OF_TYPE(Int32) OF_TYPE(UInt32)
OF_TYPE(Int64) OF_TYPE(UInt64) OF_TYPE(Boolean) OF_TYPE(String) OF_TYPE(Binary) OF_TYPE(Clock) OF_TYPE(FMUState)
OF_TYPE(IntervalDecimal) OF_TYPE(IntervalFraction) OF_TYPE(ShiftDecimal) OF_TYPE(ShiftFraction)
OF_TYPE(ContinuousStates)
REFUSED(ActivateModelPartition) REFUSED(CompletedIntegratorStep) REFUSED(DeserializeFMUState)
REFUSED(EnterConfigurationMode) REFUSED(EnterContinuousTimeMode) REFUSED(EnterEventMode) REFUSED(EnterStepMode)
REFUSED(EvaluateDiscreteStates) REFUSED(ExitConfigurationMode) REFUSED(FreeFMUState) REFUSED(GetAdjointDerivative)
REFUSED(GetContinuousStateDerivatives) REFUSED(GetDirectionalDerivative) REFUSED(GetEventIndicators)
REFUSED(GetNominalsOfContinuousStates) REFUSED(GetNumberOfContinuousStates) REFUSED(GetNumberOfEventIndicators)
REFUSED(GetNumberOfVariableDependencies) REFUSED(GetOutputDerivatives) REFUSED(GetVariableDependencies)
REFUSED(SerializeFMUState) REFUSED(SerializedFMUStateSize) REFUSED(SetDebugLogging) REFUSED(SetTime)
REFUSED(Terminate) REFUSED(UpdateDiscreteStates)

void *fmi3InstantiateModelExchange(void) { return NULL; }
void *fmi3InstantiateScheduledExecution(void) { return NULL; }
const char *fmi3GetVersion(void) { return "3.0"; }
void fmi3FreeInstance(void *lag) { free(lag); }

void *fmi3InstantiateCoSimulation(const char *name, const char *token)
{
    return name != NULL && strcmp(token, "lag") == 0 ? calloc(1, sizeof(Lag)) : NULL;
}

int fmi3Reset(Lag *lag)
{
    memset(lag, 0, sizeof *lag);
    return OK;
}

int fmi3EnterInitializationMode(Lag *lag, bool with_tolerance, double tolerance, double start)
{
    (void)with_tolerance, (void)tolerance;
    lag->value[TIME] = start;
    return lag->initialized ? ERROR : OK;
}

int fmi3ExitInitializationMode(Lag *lag)
{
    lag->initialized = true;
    return OK;
}

int fmi3GetFloat64(const Lag *lag, const unsigned vr[], size_t n, double value[])
{
    for (size_t i = 0; i < n; i++)
        value[i] = lag->value[vr[i]];
    return OK;
}

int fmi3SetFloat64(Lag *lag, const unsigned vr[], size_t n, const double value[])
{
    for (size_t i = 0; i < n; i++)
        lag->value[vr[i]] = value[i];
    return OK;
}

int fmi3DoStep(Lag *lag, double time, double step, bool no_set_before, bool *event, bool *terminate, bool *early,
               double *reached)
{
    (void)no_set_before;
    *event = *terminate = *early = false;
    if (!lag->initialized || fabs(time - lag->value[TIME]) > 1e-9)
        return ERROR;
    for (long left = lround(step / SUB); left > 0; left--) {
        const double to = K * lag->line[D - 1];

        lag->value[Y] = to + (lag->value[Y] - to) * exp(-SUB / T);
        memmove(lag->line + 1, lag->line, (D - 1) * sizeof *lag->line);
        lag->line[0] = lag->value[R_TILDE];
    }
    *reached = lag->value[TIME] = time + step;
    return OK;
}
